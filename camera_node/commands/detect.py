# SPDX-License-Identifier: BSD-3-Clause
"""`python -m camera_node detect`: detects roundels in image files."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import tyro
from rich.table import Table

from camera_node.arrays import Grey
from camera_node.detection.detector import Detector
from camera_node.detection.disc_pose import locate_all
from camera_node.detection.overlay import draw_roundels
from camera_node.detection.roundels import Roundel, Roundels
from camera_node.errors import ConfigError
from camera_node.geometry.lens import Lens, load_lens
from camera_node.sources.replay import read_grey
from camera_node.terminal import console, say


@dataclass(frozen=True, kw_only=True)
class Detect:
    """Detect the roundels in image files."""

    images: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """PNG or JPEG files."""
    json: bool = False
    """Print one JSON object for each image instead of a table."""
    draw: Path | None = None
    """Draw the roundels on the image and write it to this file; for a single image."""
    detector: Literal["chords", "paper"] = "chords"
    """The search method; paper is the reference method of Faigl et al., ICRA 2013."""
    inner_ratios: tuple[float, ...] = ()
    """Inner over outer diameters of the prints in use, such as 0.6; without any, they are found."""
    rig: Path | None = None
    """A rig.yaml with the camera's lens: adds both poses of each roundel. Requires --name and --diameter."""
    name: str | None = None
    """The camera in the rig."""
    diameter: float | None = None
    """Outer diameter of the black disc, metres."""

    def run(self) -> int:
        """Print the roundels of all images and return the exit code.

        Raises:
            ConfigError: options contradict each other, or the rig is invalid.
            CameraError: a file is missing or no image.
        """
        lens = self._lens()
        if not self.images:
            raise ConfigError("no image given; name one or more PNG or JPEG files")
        if self.draw and len(self.images) > 1:
            raise ConfigError(
                f"--draw takes one image, got {len(self.images)}; run the command once for each image"
            )
        for path in self.images:
            image = read_grey(path)
            # The images are not a sequence, so each one gets a detector without tracks.
            detector = Detector(detector=self.detector, inner_ratios=self.inner_ratios)
            roundels = detector.detect(image)
            rows = [_describe(roundel) for roundel in roundels]
            if lens is not None and self.diameter is not None:
                _add_poses(rows, roundels, lens, self.diameter)
            self._print(path, rows)
            self._draw(image, roundels)
        return 0

    def _lens(self) -> Lens | None:
        given = [self.rig is not None, self.name is not None, self.diameter is not None]
        if any(given) and not all(given):
            raise ConfigError("--rig, --name and --diameter must be given together; give all three or none")
        if self.rig is None or self.name is None or self.diameter is None:
            return None
        if not 0.001 <= self.diameter <= 10:
            raise ConfigError(f"--diameter is {self.diameter}; give the black disc's diameter in metres")
        return load_lens(self.rig, self.name)

    def _print(self, path: Path, rows: list[dict[str, Any]]) -> None:
        if self.json:
            print(json.dumps({"file": str(path), "roundels": rows}))
        else:
            say(f"{path}: {len(rows)} roundel{'' if len(rows) == 1 else 's'}")
            if rows:
                console().print(_table(rows))

    def _draw(self, image: Grey, roundels: Roundels) -> None:
        if self.draw is None:
            return
        try:
            written = cv2.imwrite(str(self.draw), draw_roundels(image, roundels))
        except cv2.error:
            written = False
        if not written:
            raise ConfigError(f"{self.draw} can't be written; give a .png or .jpg in an existing folder")


def _describe(roundel: Roundel) -> dict[str, Any]:
    return {
        "u": float(roundel.uv[0]),
        "v": float(roundel.uv[1]),
        "cov_uu": float(roundel.cov[0, 0]),
        "cov_uv": float(roundel.cov[0, 1]),
        "cov_vv": float(roundel.cov[1, 1]),
        "major_px": float(roundel.axes_px[0]),
        "minor_px": float(roundel.axes_px[1]),
        "angle_rad": roundel.angle_rad,
        "ratio": roundel.ratio,
        "contrast": roundel.contrast,
        "id": roundel.id,
    }


def _add_poses(rows: list, roundels: Roundels, lens: Lens, diameter_m: float) -> None:
    """Add `centre_u`, `centre_v` (of the likelier pose) and `poses`: None and empty where the lens has no inverse."""
    located = locate_all(roundels, lens, diameter_m)
    for row, both in zip(rows, located, strict=True):
        poses = both or ()
        centre = poses[0].centre_uv.tolist() if poses else (None, None)
        row["centre_u"], row["centre_v"] = centre
        row["poses"] = [
            {
                "position_m": pose.position_m.tolist(),
                "normal": pose.normal.tolist(),
                "probability": pose.probability,
            }
            for pose in poses
        ]


def _table(rows: list[dict[str, Any]]) -> Table:
    table = Table()
    for heading in ("u", "v", "sigma px", "major px", "minor px", "angle deg", "ratio", "contrast"):
        table.add_column(heading, justify="right")
    if any(row.get("poses") for row in rows):
        table.add_column("position m", justify="right")
    for row in rows:
        sigma = np.sqrt((row["cov_uu"] + row["cov_vv"]) / 2)
        cells = [f"{row['u']:.2f}", f"{row['v']:.2f}", f"{sigma:.3f}"]
        cells += [f"{row['major_px']:.2f}", f"{row['minor_px']:.2f}", f"{np.degrees(row['angle_rad']):.1f}"]
        cells += [f"{row['ratio']:.3f}", f"{row['contrast']:.0f}"]
        if row.get("poses"):
            cells.append(" ".join(f"{x:.3f}" for x in row["poses"][0]["position_m"]))
        table.add_row(*cells)
    return table
