# SPDX-License-Identifier: BSD-3-Clause
"""`calib intrinsics`: lenses from views of a board."""

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import track

from calib.board import BoardFinder, make_board
from calib.commands.output import check_folder, say, write_rig
from calib.intrinsics import calibrate_lens, find_cameras, merge, read_frames
from calib.rig import load_rig


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """Calibrate lenses from frames of a ChArUco board."""

    frames: Path
    """A folder of <camera>/*.png|jpg, a folder of one camera's images, a video, or a folder of videos."""
    board: str
    """charuco:COLSxROWS:SQUARE_M[:MARKER_RATIO[:DICTIONARY]]"""
    out: Path
    """The rig; other cameras in it are kept."""
    camera: str | None = None
    """The camera's name, or the only one to calibrate."""

    def execute(self, console: Console) -> None:
        """Write the cameras' entries, keep the others."""
        check_folder(self.out)
        finder = BoardFinder(make_board(self.board))
        rig = load_rig(self.out) if self.out.exists() else None
        lenses = {}
        for name, path in find_cameras(self.frames, self.camera).items():
            frames = track(
                read_frames(path), f"finding the board for {name}", transient=True, console=console
            )
            lens = lenses[name] = calibrate_lens(name, frames, finder)
            say(
                console,
                f"{name}: {lens.views} views of {lens.frames} frames, residual {lens.rms_px:.3f} px, "
                f"focal length {lens.camera.fx:.1f} px, corners in {lens.coverage:.0%} of the image",
            )
            if lens.coverage < 0.6:
                say(
                    console,
                    f"warning: {name}: show the board near the image's edges too; distortion is guessed there",
                )
        write_rig(merge(rig, lenses), self.out, console)
