# SPDX-License-Identifier: BSD-3-Clause
"""`roundel calibrate import` and `roundel calibrate export`: recordings and rigs from and to other programs."""

import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from calib.commands.output import provenance, write_rig
from calib.errors import CalibrationError
from calib.formats import argus, caliscope, colmap, kalibr, multicamselfcal, opencv
from calib.formats.data import OPENCV, ForeignData, PixelOrigin, PointTable
from calib.rig.camera import Camera
from calib.rig.rig import Rig, load_rig
from calib.world.world_frame import scale_rig
from camera_node.foundation.config import dump_yaml, write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say

Reader = Callable[[Sequence[Path], PixelOrigin], ForeignData]
Writer = Callable[[Rig, Path, PixelOrigin], list[str]]
FPS = 30  # in the printed command, for points without times; of synchronous cameras only the order of frames counts
FormatName = Literal[
    "argus",
    "easywand",
    "dltdv",
    "multicamselfcal",
    "caliscope",
    "anipose",
    "pose2sim",
    "opencv",
    "ros",
    "kalibr",
    "tagslam",
    "colmap",
]


@dataclass(frozen=True, slots=True)
class Format:
    """How a format is read and written, and where it counts pixels from."""

    read: Reader
    write: Writer
    origin: PixelOrigin


FORMATS = {
    "argus": Format(argus.read, argus.write, PixelOrigin(1, y_up=True)),
    "easywand": Format(argus.read, argus.write, PixelOrigin(1)),
    "dltdv": Format(argus.read, argus.write, PixelOrigin(1)),
    "multicamselfcal": Format(multicamselfcal.read, multicamselfcal.write, OPENCV),
    "caliscope": Format(caliscope.read, caliscope.write, OPENCV),
    "anipose": Format(caliscope.read, caliscope.write_anipose, OPENCV),
    "pose2sim": Format(caliscope.read, caliscope.write_anipose, OPENCV),
    "ros": Format(opencv.read, opencv.write, OPENCV),
    "tagslam": Format(kalibr.read, kalibr.write, OPENCV),
    "opencv": Format(opencv.read, opencv.write, OPENCV),
    "kalibr": Format(kalibr.read, kalibr.write, OPENCV),
    "colmap": Format(colmap.read, colmap.write, OPENCV),
}


@dataclass(frozen=True, kw_only=True)
class _Conversion:
    """The options of both directions."""

    format: FormatName
    """The other program."""
    out: Path
    """The folder for the files, which is made if it does not exist."""
    first_pixel: Literal[0, 1] | None = None
    """What the other program calls the first pixel; by default as the format says."""
    y_up: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """It counts rows from the lowest one; Argus does."""
    y_down: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """It counts rows from the top one; all others do."""

    def origin(self, of: Format) -> PixelOrigin:
        """The pixel origin: that of the format, with the options that are given.

        Raises:
            ConfigError: the options contradict each other.
        """
        if self.y_up and self.y_down:
            raise ConfigError("--y-up and --y-down exclude each other; give one of them, or none")
        first = of.origin.first if self.first_pixel is None else self.first_pixel
        return PixelOrigin(first, self.y_up or (of.origin.y_up and not self.y_down))

    def make_folder(self) -> None:
        """Make the folder `out`.

        Raises:
            ConfigError: it can't be made.
        """
        try:
            self.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{self.out} can't be made: {error.strerror}; give --out a folder") from None


@dataclass(frozen=True, kw_only=True)
class ImportData(_Conversion):
    """Convert cameras and points of another program to rig.yaml and observations.csv."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Its files; of MultiCamSelfCal the folder."""
    unit_m: float = 1.0
    """Metres of one unit of its positions: 0.001 where it calibrated in millimetres."""

    def run(self) -> None:
        """Read all files, then write; nothing is written if one of them is not usable."""
        chosen = FORMATS[self.format]
        if not self.files:
            raise ConfigError("give the files to import")
        if not (math.isfinite(self.unit_m) and self.unit_m > 0):
            raise ConfigError(f"--unit-m is {self.unit_m:g}; it must be above 0, in metres")
        data = chosen.read(self.files, self.origin(chosen))
        if not data.cameras and data.points is None:
            raise CalibrationError("the files have neither cameras nor points")
        rig = scale_rig(make_rig(data.cameras), self.unit_m) if data.cameras else None
        data = replace(data, cameras=rig.cameras if rig else {})
        self.make_folder()
        if rig is not None:
            write_rig(rig, self.out / "rig.yaml")
            say(f"{len(rig.cameras)} cameras, {len(rig.placed())} with poses: {', '.join(rig.cameras)}")
        for remark in data.remarks:
            say(remark)
        if data.points is not None:
            self._write_points(data, data.points)

    def _write_points(self, data: ForeignData, points: PointTable) -> None:
        path = self.out / "observations.csv"
        points.write(path)
        markers, cameras = int(points.marker.max()) + 1, len(set(points.camera))
        frames = len(set(points.frame.tolist()))
        say(f"wrote {path}: {len(points)} points, {markers} markers, {cameras} cameras, {frames} frames")
        wand = self.out / "wand.yaml"
        if data.wand is not None:
            write_atomically(wand, dump_yaml(data.wand))
            say(f"wrote {wand}")
        elif not wand.exists():
            say(
                f"write {wand} first: markers: [[x, y, z], ...], the place of each of the {markers} points, metres"
            )
        self._print_next(data, points, path, wand)

    def _print_next(self, data: ForeignData, points: PointTable, path: Path, wand: Path) -> None:
        """Print the command that calibrates from the files."""
        rig = self.out / "rig.yaml"
        if not data.cameras and not rig.exists():
            say(f"write {rig} first: import the files of the cameras with the same --out")
        words: list[object] = ["--rig", rig, "--observations", path]
        words += ["--synchronised", "--fps", FPS] if points.t_s is None else []
        words += ["--wand", wand]
        if data.wand is not None and len(data.wand.markers) == 1 and (ends := _widest_pair(data.cameras)):
            words += ["--distance", *ends]
        words += ["--out", self.out / "calibrated.yaml"]
        say("next: " + shlex.join(["roundel", "calibrate", "wand", *map(str, words)]))


def _widest_pair(cameras: Mapping[str, Camera]) -> tuple[str, str, str] | None:
    """The two cameras with poses that are farthest apart, and the metres between them: the scale for one marker."""
    placed = {
        name: camera.matrix()[:3, 3] for name, camera in cameras.items() if camera.T_world_cam is not None
    }
    gaps = {(a, b): float(np.linalg.norm(placed[a] - placed[b])) for a, b in combinations(placed, 2)}
    if not gaps:
        return None
    a, b = max(gaps, key=gaps.__getitem__)
    return a, b, f"{gaps[a, b]:.4f}"


def make_rig(cameras: dict[str, Camera]) -> Rig:
    """The rig of imported cameras.

    Raises:
        CalibrationError: a value or a name is not plausible.
    """
    try:
        return Rig(cameras=cameras, calibration=provenance())
    except ValueError as error:
        raise CalibrationError(str(error)) from None


@dataclass(frozen=True, kw_only=True)
class ExportRig(_Conversion):
    """Convert a rig to the files of another program."""

    rig: Path
    """The rig."""

    def run(self) -> None:
        """Write the files and print their names."""
        chosen, rig = FORMATS[self.format], load_rig(self.rig)
        self.make_folder()
        for name in chosen.write(rig, self.out, self.origin(chosen)):
            say(f"wrote {self.out / name}")
