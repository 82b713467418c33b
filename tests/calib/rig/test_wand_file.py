# SPDX-License-Identifier: BSD-3-Clause
"""Wands of lights and points have no diameter; wands of roundels need one."""

from pathlib import Path

import pytest

from calib.errors import CalibrationError
from calib.rig.wand_file import load_wand
from calib.wand.calibrate import calibrate
from camera_node.foundation.errors import ConfigError
from tests.calib.synthetic import WAND, record, ring


def test_a_light_needs_no_diameter(tmp_path: Path):
    (tmp_path / "light.yaml").write_text("markers: [[0, 0, 0]]\n")
    assert load_wand(tmp_path / "light.yaml").diameter_m == 0
    (tmp_path / "light.yaml").write_text("diameter_m: 0.00001\n")
    with pytest.raises(ConfigError, match="give the black disc's diameter"):
        load_wand(tmp_path / "light.yaml")


def test_roundels_with_sizes_need_a_diameter(tmp_path: Path):
    (tmp_path / "wand.yaml").write_text(f"markers: {[list(m) for m in WAND.markers]}\n")
    arena = ring(2)
    with pytest.raises(CalibrationError, match="wand file has no diameter_m"):
        calibrate(arena.intrinsics, load_wand(tmp_path / "wand.yaml"), record(arena, 1.0))
