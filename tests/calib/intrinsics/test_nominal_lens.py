# SPDX-License-Identifier: BSD-3-Clause
"""Cameras without lens calibration: the wand finds their lenses from the nominal one."""

import numpy as np
import pytest

from calib.intrinsics.nominal_lens import nominal_lens, with_nominal_lenses
from calib.rig.rig import Rig


@pytest.mark.parametrize(("width", "height"), [(640, 480), (1920, 1080)])
def test_the_nominal_lens_has_sixty_degrees(width: int, height: int):
    """Between the rays of the outermost pixels' outer edges; square pixels, the centre in the middle."""
    lens = nominal_lens(width, height)
    edges = (np.array([-0.5, width - 0.5]) - lens.cx) / lens.fx
    assert np.degrees(np.arctan(edges)) == pytest.approx([-30, 30])
    assert lens.fx == lens.fy
    assert (2 * lens.cx, 2 * lens.cy) == (width - 1, height - 1)


def test_known_lenses_stay():
    """Only cameras that the rig lacks get a nominal lens."""
    known = Rig(cameras={"a": nominal_lens(320, 240)}, calibration={"grade": "A"})
    completed, missing = with_nominal_lenses(known, {"a": (640, 480), "b": (640, 480)})
    assert missing == ["b"]
    assert completed.cameras["a"] == known.cameras["a"]
    assert completed.calibration == known.calibration
