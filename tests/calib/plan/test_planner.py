# SPDX-License-Identifier: BSD-3-Clause
"""The paper's sensor model, and the evaluation of a plan."""

import re
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calib.plan.planner import Plan, PlannedCamera, evaluate_plan, sees_level, sensor_range
from camera_node.config import load_yaml
from camera_node.errors import ConfigError
from tests.conftest import ROOT

PLAN = load_yaml(ROOT / "configs" / "plan.yaml", Plan)


def test_the_sensor_model_reproduces_the_paper():
    """d_o = 14 cm, D = 11 px; the paper's 640 x 480 camera reaches 5.5 m, which is f = 432 px."""
    camera = PlannedCamera(
        width=640, height=480, focal_px=432.0, position_m=(0, 0, 3), look_at_m=(0, 0.1, 0)
    ).camera()
    reach = sensor_range(camera, 0.14, 11.0, 0.0)
    assert reach.v_max == pytest.approx(5.5, abs=0.01)
    assert reach.v_min == pytest.approx(0.14 * 432 / 480)
    assert reach.v_y == pytest.approx(5.5 * 640 / 432 - 0.28, abs=0.02)
    assert reach.v_z == pytest.approx(5.5 * 480 / 432 - 0.28, abs=0.02)
    tilted = sensor_range(camera, 0.14, 11.0, np.radians(60))
    assert tilted.v_max == pytest.approx(reach.v_max / 2)


def test_a_level_roundel_is_seen_while_its_minor_axis_is_large_enough():
    """Directly below the camera up to v_max, and only while it is completely in the image."""
    camera = PlannedCamera(
        width=640, height=480, focal_px=440.0, position_m=(0, 0, 4), look_at_m=(0, 1e-6, 0)
    ).camera()
    heights = np.array([[0.0, 0.0, 4 - 3.9], [0.0, 0.0, 4 - 4.1]])
    assert sees_level(camera, heights, 0.1, 11.0).tolist() == [True, False]
    edge = 320 / 440 * 3.0
    assert sees_level(camera, np.array([[edge - 0.06, 0, 1], [edge - 0.04, 0, 1]]), 0.1, 5.0).tolist() == [
        True,
        False,
    ]


def test_more_cameras_are_more_precise():
    """Errors decrease with the number of cameras; an area that no camera sees has no finite error."""
    four = evaluate_plan(PLAN).precision
    two = evaluate_plan(
        msgspec.structs.replace(PLAN, cameras={n: PLAN.cameras[n] for n in ("north", "east")})
    ).precision
    both = np.isfinite(two.sigma_mm)
    assert both.any()
    assert (four.sigma_mm[both] < two.sigma_mm[both] + 1e-9).all()
    assert four.covered >= two.covered
    far = evaluate_plan(msgspec.structs.replace(PLAN, area_m=(50.0, 50.0, 52.0, 52.0))).precision
    assert (far.covered, far.typical_mm) == (0.0, float("inf"))


def test_the_shipped_plan_on_the_command_line(tmp_path: Path):
    picture = tmp_path / "map.png"
    options = ["plan", str(ROOT / "configs" / "plan.yaml"), "--map", str(picture)]
    command = [sys.executable, "-m", "calib", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    diameter_m = load_yaml(ROOT / "configs" / "plan.yaml", Plan).diameter_m
    assert f"north: level roundels of {diameter_m:g} m from" in done.stdout
    covered = re.search(r"two cameras or more see (\d+)% of the area", done.stdout)
    assert covered is not None
    assert int(covered[1]) >= 90
    assert picture.stat().st_size > 1000


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ("fov_deg: 75, focal_px: 900", "one of fov_deg and focal_px"),
        ("fov_deg: 190", "1 to 170"),
        ("focal_px: -3", "focal lengths"),
        ("lens: 3", "unknown field"),
    ],
)
def test_a_broken_plan_names_the_camera(tmp_path: Path, change: str, fault: str):
    text = (ROOT / "configs" / "plan.yaml").read_text().replace("fov_deg: 75", change, 1)
    (tmp_path / "plan.yaml").write_text(text)
    with pytest.raises(ConfigError, match=fault) as error:
        load_yaml(tmp_path / "plan.yaml", Plan)
    assert "north" in str(error.value)
