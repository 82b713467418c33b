# SPDX-License-Identifier: BSD-3-Clause
"""Recordings and wand files that cannot be right are refused, with the figures that show it."""

import re

import msgspec
import pytest

from calib.errors import CalibrationError
from calib.wand.calibrate import calibrate
from tests.calib.synthetic import WAND, Arena, record, ring

STICK_WITH_ROUNDELS = msgspec.structs.replace(WAND, markers=((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)))


def test_a_wand_at_rest_is_refused():
    arena = Arena(ring(3).truth, speed=0.0)
    with pytest.raises(CalibrationError, match=r"moved: by 0\.\d px .*'cam\d'"):
        calibrate(arena.intrinsics, arena.wand, record(arena, 5.0, sigma_px=0.1))


def test_a_wand_file_with_a_wrong_spacing_is_refused():
    """The middle marker is 3 cm off in the file: the message has the distance of the file and the measured one. With
    6 cm, no two cameras fit."""
    arena = ring(4)
    wrong = msgspec.structs.replace(WAND, markers=((0.0, 0.0, 0.0), (0.17, 0.0, 0.0), (0.5, 0.0, 0.0)))
    messages = record(arena, 8.0, sigma_px=0.1, sized=False, numbered=True)
    with pytest.raises(CalibrationError, match=r"markers 0 and 1 .*0\.170 m") as caught:
        calibrate(arena.intrinsics, wrong, messages)
    lengths = [float(length) for length in re.findall(r"(\d\.\d{3}) m", str(caught.value))]
    assert lengths == [0.17, pytest.approx(0.2, abs=0.01)]  # scale and spacing share the error
    far_off = msgspec.structs.replace(WAND, markers=((0.0, 0.0, 0.0), (0.14, 0.0, 0.0), (0.5, 0.0, 0.0)))
    with pytest.raises(
        CalibrationError, match=r"'cam\d' and 'cam\d' .* in \d+ frame sets.* measure the wand"
    ):
        calibrate(arena.intrinsics, far_off, messages)


@pytest.mark.parametrize("sigma_px", [pytest.param(0.1, marks=pytest.mark.slow), 0.4])
def test_a_length_of_6_percent_too_much_is_refused_by_the_sizes(sigma_px: float):
    """0.53 m for 0.50: two markers have no ratio, but their sizes have. The stated diameter reconciles both, and the
    true length too."""
    arena = ring(3, wand=STICK_WITH_ROUNDELS)
    messages = record(arena, 8.0, sigma_px=sigma_px, numbered=True)
    longer = msgspec.structs.replace(STICK_WITH_ROUNDELS, markers=((0.0, 0.0, 0.0), (0.53, 0.0, 0.0)))
    with pytest.raises(CalibrationError, match=r"sizes disagree by 6%: .* is 0\.12[67]\d m across") as caught:
        calibrate(arena.intrinsics, longer, messages)
    across = float(re.findall(r"is (0\.\d+) m across", str(caught.value))[0])
    assert calibrate(arena.intrinsics, msgspec.structs.replace(longer, diameter_m=across), messages).names
    assert len(calibrate(arena.intrinsics, STICK_WITH_ROUNDELS, messages).names) == 3
