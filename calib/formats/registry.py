# SPDX-License-Identifier: BSD-3-Clause
"""The formats of other programs by name."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from calib.formats import argus, caliscope, colmap, kalibr, multicamselfcal, opencv
from calib.formats.data import ForeignData, PixelOrigin
from calib.rig.rig import Rig

Reader = Callable[[Sequence[Path], PixelOrigin], ForeignData]
Writer = Callable[[Rig, Path, PixelOrigin], list[str]]


@dataclass(frozen=True, slots=True)
class Format:
    """How a format is read (None: export only) and written, and where it counts pixels from."""

    read: Reader | None
    write: Writer
    origin: PixelOrigin


FORMATS = {
    "argus": Format(argus.read, argus.write, argus.ARGUS),
    "easywand": Format(argus.read, argus.write, argus.DLTDV8),
    "dltdv": Format(argus.read, argus.write, argus.DLTDV8),
    "multicamselfcal": Format(multicamselfcal.read, multicamselfcal.write, multicamselfcal.FROM_ZERO),
    "caliscope": Format(caliscope.read, caliscope.write, caliscope.FROM_ZERO),
    "opencv": Format(opencv.read, opencv.write, opencv.FROM_ZERO),
    "kalibr": Format(kalibr.read, kalibr.write, kalibr.FROM_ZERO),
    "colmap": Format(None, colmap.write, colmap.FROM_ZERO),
}
