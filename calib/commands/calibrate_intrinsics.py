# SPDX-License-Identifier: BSD-3-Clause
"""`roundel calibrate intrinsics`: calibrates lenses from views of a board."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rich.live import Live

from calib.commands.inputs import require_one
from calib.commands.output import check_folder, provenance, save_image, write_rig
from calib.errors import CalibrationError
from calib.intrinsics.board import make_finder
from calib.intrinsics.guided_capture import capture_views, make_panel
from calib.intrinsics.images import find_cameras, read_frames, take_snapshots
from calib.intrinsics.lens_calibration import BoardViews, CalibratedLens, Model, merge_lenses
from calib.intrinsics.residual_plot import draw_residuals
from calib.rig.rig import load_rig
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import progress_console, say, track
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """Calibrate lenses from images of a ChArUco board or a chessboard."""

    board: str
    """charuco:COLSxROWS:SQUARE_M[:MARKER_RATIO[:DICTIONARY]] in squares, or chessboard:COLSxROWS:SQUARE_M in inner
    corners."""
    out: Path
    """The rig; its other cameras stay, and the previous file is saved as rig.1.yaml, ..."""
    frames: Path | None = None
    """A folder of <camera>/*.png|jpg, a folder of one camera's images, a video, or a folder of videos."""
    live: bool = False
    """Or request images from a running camera, and show the covered part of its image."""
    camera: str | None = None
    """The camera's name, or the only one to calibrate."""
    model: Model = "pinhole"
    """OpenCV's pinhole model with 5 distortion coefficients, or its fisheye model with 4 (for lenses beyond 120
    degrees)."""
    maps: Path | None = None
    """A folder for an image of each camera's residuals."""
    seconds: float = 180.0
    """The longest time for which images are requested from a running camera."""
    connection: ConnectionOptions = LOCAL_SERVER

    def run(self) -> None:
        """Calibrate, and write the lenses that are good; of the other cameras, the reasons are given.

        Raises:
            CalibrationError: a lens can't be calibrated; nothing is written if that is so for all.
        """
        check_folder(self.out)
        require_one({"--frames FOLDER": self.frames, "--live": self.live})
        if self.live and self.camera is None:
            raise ConfigError("--live needs --camera NAME, as the camera was started with --name")
        rig = load_rig(self.out) if self.out.exists() else None
        lenses: dict[str, CalibratedLens] = {}
        faults: dict[str, list[str]] = {}
        for views in self._collect_views():
            try:
                lens = views.calibrate(self.model)
            except CalibrationError as error:
                fault = str(error).removeprefix(f"camera '{views.camera}': ")
                faults.setdefault(fault, []).append(views.camera)
                continue
            lenses[views.camera] = lens
            print_lens(views.camera, lens)
            if self.maps:
                image = draw_residuals(views.camera, lens.camera, lens.observed(), lens.residuals())
                save_image(self.maps / f"{views.camera}.png", image)
        if lenses:
            write_rig(merge_lenses(rig, lenses, {**provenance(), "board": self.board}), self.out)
        if faults:
            written = f"; written without it: {', '.join(lenses)}" if lenses else ""
            each = (f"camera {', '.join(map(repr, cameras))}: {fault}" for fault, cameras in faults.items())
            raise CalibrationError("; ".join(each) + written)

    def _collect_views(self) -> Iterator[BoardViews]:
        finder = make_finder(self.board)
        if self.live:
            yield self._capture(BoardViews(self.camera or "", finder))
            return
        assert self.frames is not None
        for name, path in find_cameras(self.frames, self.camera).items():
            views = BoardViews(name, finder)
            for image_name, image in track(read_frames(path), f"finding the board for {name}"):
                views.add(image_name, image)
            yield views

    def _capture(self, views: BoardViews) -> BoardViews:
        with self.connection.open() as session:
            images = take_snapshots(session, self.connection.arena, views.camera, self.seconds)
            with Live(console=progress_console(), transient=True) as live:
                say(
                    capture_views(
                        views, images, self.model, lambda progress: live.update(make_panel(progress))
                    )
                )
        return views


def print_lens(name: str, lens: CalibratedLens) -> None:
    """Print the figures of a lens, the outliers, and warnings."""
    sigma = lens.camera.lens_sigma or (0.0,)
    say(
        f"{name}: {len(lens.views)} views of {lens.frames} frames, residual {lens.rms_px:.3f} px, focal length "
        f"{lens.camera.fx:.1f} px +- {sigma[0]:.1f}, board in {lens.coverage.share():.0%} of the image"
    )
    if lens.rejected:
        worst = sorted(lens.rejected.items(), key=lambda entry: -entry[1])
        views = ", ".join(f"{view} ({rms:.1f} px)" for view, rms in worst)
        say(f"{name}: views rejected as outliers: {views}")
    for warning in lens.warnings():
        say(f"warning: {name}: {warning}")
