# SPDX-License-Identifier: BSD-3-Clause
"""`roundel detect`: detects roundels in image files."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import tyro
from rich.table import Table

from camera_node.detection.detector import Detector, DetectorSettings
from camera_node.detection.disc_pose import locate_all
from camera_node.detection.overlay import draw_refused, draw_roundels
from camera_node.detection.refusals import RefusedRing, explain
from camera_node.detection.roundels import Roundel, Roundels
from camera_node.foundation.arrays import Grey
from camera_node.foundation.errors import CameraError, ConfigError, unwritable
from camera_node.foundation.terminal import console, say
from camera_node.geometry.lens import Lens, load_lens
from camera_node.sources.recorded_frames import read_grey

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")  # of the pictures of a folder
PASSES = 2  # over a picture: the first one learns prints and tone curve


@dataclass(frozen=True, kw_only=True)
class Detect:
    """Detect the roundels in image files."""

    images: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """PNG or JPEG files, or folders of them."""
    json: bool = False
    """Print one JSON object for each image instead of a table."""
    why: bool = False
    """Also list the ring-like shapes that are no roundels, with the test that each of them fails."""
    draw: Path | None = None
    """Draw the roundels (and refused rings) on the image and write it to this file; a folder for several images."""
    detector: Literal["chords", "paper"] = "chords"
    """The search method; paper is the reference method of Faigl et al., ICRA 2013."""
    inner_ratios: tuple[float, ...] = ()
    """Inner over outer diameters of the prints in use, such as 0.6; without any, they are found."""
    ratio_tolerance: float = DetectorSettings.ratio_tolerance
    """Largest difference between a measured ratio and that of a print."""
    min_diameter_px: float = DetectorSettings.min_diameter_px
    """Least major axis of the black disc, pixels."""
    max_diameter_px: float = DetectorSettings.max_diameter_px
    """Greatest major axis of the black disc, pixels."""
    min_contrast: float = DetectorSettings.min_contrast
    """Least difference of paper and ink, grey levels."""
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
        paths = list(_pictures(self.images))
        if not paths:
            raise ConfigError("no image given; name PNG or JPEG files, or folders of them")
        if self.draw and len(paths) > 1:
            _make_folder(self.draw, len(paths))
        for path in paths:
            self._inspect(path, lens, one_of=len(paths))
        return 0

    def _inspect(self, path: Path, lens: Lens | None, one_of: int) -> None:
        image = read_grey(path)
        if lens is not None and (size := image.shape[::-1]) != (lens.width, lens.height):
            raise ConfigError(
                f"{path} has {size[0]} x {size[1]} pixels, the lens of '{self.name}' in {self.rig} is for "
                f"{lens.width} x {lens.height}; give pictures of that size, or calibrate the lens at this one"
            )
        detector, roundels = self._detect(image)
        refused = explain(detector, image, roundels) if self.why else []
        rows = [_describe(roundel) for roundel in roundels]
        if lens is not None and self.diameter is not None:
            _add_poses(rows, roundels, lens, self.diameter)
        self._print(path, rows, refused)
        if self.draw:
            to = self.draw if one_of == 1 else self.draw / f"{path.parent.name}_{path.stem}.png"
            _draw(image, roundels, refused, to)
            if not self.json:  # whose output has JSON only
                say(f"wrote {to}")

    def _detect(self, image: Grey) -> tuple[Detector, Roundels]:
        """The roundels of an image. The images are not a sequence, so each one gets a detector without tracks."""
        names = {f.name for f in fields(DetectorSettings)} & {f.name for f in fields(self)}
        detector = Detector(detector=self.detector, **{name: getattr(self, name) for name in names})
        for _ in range(PASSES - 1):
            detector.detect(image)
        return detector, detector.detect(image)

    def _lens(self) -> Lens | None:
        given = [self.rig is not None, self.name is not None, self.diameter is not None]
        if any(given) and not all(given):
            raise ConfigError("--rig, --name and --diameter must be given together; give all three or none")
        if self.rig is None or self.name is None or self.diameter is None:
            return None
        if not 0.001 <= self.diameter <= 10:
            raise ConfigError(f"--diameter is {self.diameter}; give the black disc's diameter in metres")
        return load_lens(self.rig, self.name)

    def _print(self, path: Path, rows: list[dict[str, Any]], refused: list[RefusedRing]) -> None:
        if self.json:
            why = {"refused": [_describe_refused(ring) for ring in refused]} if self.why else {}
            print(json.dumps({"file": str(path), "roundels": rows, **why}))
            return
        say(f"{path}: {len(rows)} roundel{'' if len(rows) == 1 else 's'}")
        if rows:
            console().print(_table(rows))
        if self.why:
            say(f"{path}: {len(refused)} ring-like shape{'' if len(refused) == 1 else 's'} refused")
        for ring in refused:
            u, v, size = *ring.uv, ring.axes_px[0]
            say(f"  at u {u:.0f}, v {v:.0f}, {size:.0f} px wide: {ring.text}")


def _pictures(paths: tuple[Path, ...]) -> Iterator[Path]:
    """The files, and those of the folders by name."""
    for path in paths:
        if not path.is_dir():
            yield path
            continue
        inside = _pictures_in(path)
        if not inside:
            raise CameraError(f"{path} has no picture; {_folder_with_pictures(path)}")
        yield from inside


def _pictures_in(folder: Path) -> list[Path]:
    return [file for file in sorted(folder.iterdir()) if file.suffix.lower() in SUFFIXES]


def _folder_with_pictures(folder: Path) -> str:
    """The advice to give the first folder with pictures inside this one, or inside a folder of it."""
    inner = (path for pattern in ("*", "*/*") for path in sorted(folder.glob(pattern)) if path.is_dir())
    found = next((path for path in inner if _pictures_in(path)), None)
    return f"it has folders: give {found}" if found else "it needs files such as .png"


def _make_folder(path: Path, n_images: int) -> None:
    if path.suffix.lower() in SUFFIXES or (path.exists() and not path.is_dir()):
        raise ConfigError(f"--draw names the file {path}, for {n_images} images; name a folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(path, error) from None


def _draw(image: Grey, roundels: Roundels, refused: list[RefusedRing], to: Path) -> None:
    canvas = draw_roundels(image, roundels)
    draw_refused(canvas, refused)
    try:
        written = cv2.imwrite(str(to), canvas)
    except cv2.error:
        written = False
    if not written:
        raise ConfigError(f"{to} can't be written; give a .png or .jpg in an existing folder")


def _describe_refused(ring: RefusedRing) -> dict[str, Any]:
    return {
        "u": float(ring.uv[0]),
        "v": float(ring.uv[1]),
        "major_px": float(ring.axes_px[0]),
        "minor_px": float(ring.axes_px[1]),
        "angle_rad": ring.angle_rad,
        "ratio": ring.ratio,
        "contrast": ring.contrast,
        "misfit": ring.misfit,
        "reason": ring.reason.name.lower(),
        "text": ring.text,
    }


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
        "id_probability": _known(roundel.id_probability),
        "rotation_rad": _known(roundel.rotation_rad),
        "rotation_sigma": _known(roundel.rotation_sigma),
    }


def _known(value: float) -> float | None:
    """JSON has no NaN."""
    return None if np.isnan(value) else value


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
    has_codes = any(row["id"] is not None for row in rows)
    if has_codes:
        table.add_column("code", justify="right")
    if any(row.get("poses") for row in rows):
        table.add_column("position m", justify="right")
    for row in rows:
        sigma = np.sqrt((row["cov_uu"] + row["cov_vv"]) / 2)
        cells = [f"{row['u']:.2f}", f"{row['v']:.2f}", f"{sigma:.3f}"]
        cells += [f"{row['major_px']:.2f}", f"{row['minor_px']:.2f}", f"{np.degrees(row['angle_rad']):.1f}"]
        cells += [f"{row['ratio']:.3f}", f"{row['contrast']:.0f}"]
        if has_codes:
            cells.append("" if row["id"] is None else str(row["id"]))
        if row.get("poses"):
            cells.append(" ".join(f"{x:.3f}" for x in row["poses"][0]["position_m"]))
        table.add_row(*cells)
    return table
