# SPDX-License-Identifier: BSD-3-Clause
"""`calib intrinsics`: lenses from views of a board."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.live import Live

from calib.commands.choice import require_one
from calib.commands.connection import Connection, Server
from calib.commands.output import check_folder, provenance, say, write_rig
from calib.intrinsics.board import make_finder
from calib.intrinsics.calibrate import BoardViews, CalibratedLens, Model, merge
from calib.intrinsics.guided_capture import show_board
from calib.intrinsics.images import find_cameras, read_frames, take_snapshots
from calib.intrinsics.residual_plot import draw_residuals, save_map
from calib.rig.rig import load_rig
from camera_node.errors import ConfigError
from camera_node.terminal import progress_console, track


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """Calibrate lenses from pictures of a ChArUco board or a chessboard."""

    board: str
    """charuco:COLSxROWS:SQUARE_M[:MARKER_RATIO[:DICTIONARY]] in squares, or chessboard:COLSxROWS:SQUARE_M in inner
    corners."""
    out: Path
    """The rig; other cameras in it are kept, and the rig before as rig.1.yaml, ..."""
    frames: Path | None = None
    """A folder of <camera>/*.png|jpg, a folder of one camera's images, a video, or a folder of videos."""
    live: bool = False
    """Or ask a running camera for pictures, and show how its image fills."""
    camera: str | None = None
    """The camera's name, or the only one to calibrate."""
    model: Model = "pinhole"
    """OpenCV's pinhole with 5 distortion numbers, or its fisheye with 4 (for lenses beyond 120 degrees)."""
    maps: Path | None = None
    """A folder for a picture of each camera's residuals."""
    seconds: float = 180.0
    """How long a running camera is asked at the most."""
    server: Server = field(default_factory=Connection)

    def execute(self, console: Console) -> None:
        """Write the cameras' entries, keep the others; nothing is written unless all are good."""
        check_folder(self.out)
        require_one({"--frames FOLDER": self.frames, "--live": self.live})
        if self.live and self.camera is None:
            raise ConfigError("--live needs --camera NAME, as the camera was started with --name")
        rig = load_rig(self.out) if self.out.exists() else None
        lenses = {}
        for views in self._look(console):
            lenses[views.camera] = lens = views.solve(self.model)
            report(views.camera, lens, console)
            if self.maps:
                picture = draw_residuals(views.camera, lens.camera, lens.seen(), lens.residuals())
                save_map(self.maps / f"{views.camera}.png", picture)
        told = {**provenance(), "board": self.board}
        write_rig(merge(rig, lenses, told), self.out, console)

    def _look(self, console: Console) -> Iterator[BoardViews]:
        finder = make_finder(self.board)
        if self.live:
            yield self._watch(BoardViews(self.camera or "", finder), console)
            return
        assert self.frames is not None
        for name, path in find_cameras(self.frames, self.camera).items():
            views = BoardViews(name, finder)
            pictures = read_frames(path)
            for picture, image in track(pictures, f"finding the board for {name}"):
                views.add(picture, image)
            yield views

    def _watch(self, views: BoardViews, console: Console) -> BoardViews:
        with self.server.open() as session:
            pictures = take_snapshots(session, self.server.arena, views.camera, self.seconds)
            with Live(console=progress_console(), transient=True) as live:
                say(console, show_board(views, pictures, self.model, live.update))
        return views


def report(name: str, lens: CalibratedLens, console: Console) -> None:
    """Tell what a person should know of a lens."""
    sigma = lens.camera.lens_sigma or (0.0,)
    say(
        console,
        f"{name}: {len(lens.views)} views of {lens.frames} frames, residual {lens.rms_px:.3f} px, focal length "
        f"{lens.camera.fx:.1f} px +- {sigma[0]:.1f}, board in {lens.coverage.share():.0%} of the image",
    )
    if lens.rejected:
        worst = sorted(lens.rejected.items(), key=lambda entry: -entry[1])
        told = ", ".join(f"{view} ({rms:.1f} px)" for view, rms in worst)
        say(console, f"{name}: views left out as outliers: {told}")
    for warning in lens.warnings():
        say(console, f"warning: {name}: {warning}")
