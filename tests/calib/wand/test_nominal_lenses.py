# SPDX-License-Identifier: BSD-3-Clause
"""Cameras without lens calibration: the wand finds lenses and poses from the nominal lens."""

import math

import msgspec
import numpy as np
import pytest

from calib.intrinsics.nominal_lens import with_nominal_lenses
from calib.rig.rig import Rig
from calib.wand.calibrate import calibrate
from tests.calib.synthetic import Arena, errors, record, ring


def with_field_of_view(arena: Arena, degrees: float) -> Arena:
    """The arena with other focal lengths; the cameras differ by 10 px, as in `ring`."""
    focal = 400 / math.tan(math.radians(degrees / 2))
    cameras = {
        name: msgspec.structs.replace(camera, fx=focal + 10 * k, fy=focal + 10 * k + 2)
        for k, (name, camera) in enumerate(arena.truth.cameras.items())
    }
    return Arena(Rig(cameras=cameras))


@pytest.mark.parametrize("degrees", [pytest.param(50.0, marks=pytest.mark.slow), 60.0, 70.0])
def test_the_wand_finds_lenses_from_fifty_to_seventy_degrees(degrees: float):
    """20 s of 0.1 px. The focal lengths come within 0.5 %; poses within 5 mm, 0.2 % of the distance to the wand."""
    arena = with_field_of_view(ring(), degrees)
    messages = record(arena, 20.0, sigma_px=0.1)
    rig, missing = with_nominal_lenses(Rig(cameras={}), {m.camera: (m.width, m.height) for m in messages})
    assert missing == sorted(arena.truth.cameras)
    found = calibrate(rig, arena.wand, messages).rig
    ratios = [found.cameras[name].fx / camera.fx for name, camera in arena.truth.cameras.items()]
    assert np.allclose(ratios, 1.0, atol=5e-3)
    assert errors(found, arena.truth)[0] < 5e-3
