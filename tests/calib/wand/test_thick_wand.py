# SPDX-License-Identifier: BSD-3-Clause
"""A wand with roundels back to back on both sides of a board: each camera sees one side, half the thickness away."""

import re

import msgspec
import pytest

from calib.wand.calibrate import calibrate
from camera_node.geometry.body import PrintedWand
from tests.calib.synthetic import WAND, assert_near, record, ring

BOARD = PrintedWand(diameter_m=WAND.diameter_m, markers=WAND.markers, thickness_m=0.02)


def test_a_thick_wand_is_as_exact_as_one_without_thickness():
    """Detections without noise. Without the thickness, cameras on opposite sides see places 20 mm apart, so one of them
    contradicts the others, and the reason says what the file may lack. With it, the error of a normal remains: 1 degree
    moves a print by 0.17 mm in one frame set."""
    arena = ring(4, wand=BOARD)
    messages = record(arena, 7.0)
    assert_near(calibrate(arena.intrinsics, BOARD, messages).rig, arena.truth, 3e-4, 2e-4)
    thin = msgspec.structs.replace(BOARD, thickness_m=0.0)
    unplaced = calibrate(arena.intrinsics, thin, messages).report.unplaced
    assert len(unplaced) == 1
    assert "needs thickness_m in its file" in next(iter(unplaced.values()))


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"thickness_m": -0.01}, "give metres from 0 to 0.1"),
        ({"thickness_m": float("nan")}, "give metres from 0 to 0.1"),
        ({"normals": ((0, 1, 0),) * 3}, "leave normals out"),
        ({"thickness_m": 0.01, "markers": ((0, 0, 0), (0.3, 0, 0), (0.1, 0.1, 0))}, "on a line"),
    ],
)
def test_impossible_wands_are_refused(fields: dict, reason: str):
    with pytest.raises(ValueError, match=re.escape(reason)):
        PrintedWand(**{"diameter_m": 0.1, "markers": WAND.markers} | fields)
