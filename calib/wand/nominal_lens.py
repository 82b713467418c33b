# SPDX-License-Identifier: BSD-3-Clause
"""Lenses of cameras that were never calibrated: a guess, from which the wand calibration finds the lens.

The guess is a field of view of 60 degrees without distortion, and the focal length may be half or twice of it:
`lens_sigma` says so. Lenses far beyond, fisheyes, and every lens where millimetres count need a board.
"""

import math
from collections.abc import Mapping
from pathlib import Path

import msgspec

from calib.rig.camera import Camera
from calib.rig.rig import Rig, load_rig
from calib.wand.bundle_adjustment.covariance import parameter_sigma, unknown_sigma

FIELD_OF_VIEW_DEG = 60.0  # horizontal; most webcams and Pi cameras have 54 to 70


def nominal_lens(width: int, height: int, degrees: float = FIELD_OF_VIEW_DEG) -> Camera:
    """A camera of this image size, pixels, with the standard deviations of a guess.

    Args:
        width, height: of its images.
        degrees: horizontal field of view.
    """
    focal_px = width / 2 / math.tan(math.radians(degrees / 2))
    centre = (width - 1) / 2, (height - 1) / 2
    guess = Camera(
        width=width,
        height=height,
        fx=focal_px,
        fy=focal_px,
        cx=centre[0],
        cy=centre[1],
        distortion=(0.0,) * 5,
    )
    return msgspec.structs.replace(guess, lens_sigma=parameter_sigma(guess, None, unknown_sigma(guess)))


def with_nominal_lenses(
    rig: Rig, sizes: Mapping[str, tuple[int, int]], degrees: float = FIELD_OF_VIEW_DEG
) -> tuple[Rig, list[str]]:
    """The rig with a nominal lens for each camera that it lacks, and the names of these.

    Args:
        rig: the known lenses.
        sizes: width and height of the images, pixels, by camera.
        degrees: horizontal field of view of the nominal lenses.
    """
    missing = sorted(sizes.keys() - rig.cameras.keys())
    lenses = {name: nominal_lens(*sizes[name], degrees) for name in missing}
    return Rig(cameras={**rig.cameras, **lenses}, calibration=rig.calibration), missing


def load_known_lenses(path: Path) -> Rig:
    """Like `load_rig`; a rig without cameras if there is no file."""
    return load_rig(path) if path.exists() else Rig(cameras={})
