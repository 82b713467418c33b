# SPDX-License-Identifier: BSD-3-Clause
"""Descriptions of arenas: lenses, grids, and errors that name the place of a fault."""

from pathlib import Path

import numpy as np
import pytest

from calib.plan.camera_kind import CameraKind
from calib.plan.description import Plan, Volume, find_regions
from camera_node.foundation.config import load_yaml
from camera_node.foundation.errors import ConfigError
from tests.conftest import ROOT


def test_a_lens_is_given_by_its_field_of_view_its_focal_length_or_the_catalogue():
    assert CameraKind(width=1000, height=800, fov_deg=90).focal == pytest.approx(500)
    assert CameraKind(width=1000, height=800, fov_deg=180 / np.pi * 2 - 1e-9, lens="fisheye").focal == (
        pytest.approx(500)
    )
    assert CameraKind(model="imx273").focal == pytest.approx(4.0 / 3.45e-3)
    assert CameraKind(model="imx273", focal_mm=8.0).focal == pytest.approx(8.0 / 3.45e-3)
    assert CameraKind(model="imx273", fps=30.0).rate == 30.0


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ("fov_deg: 75, focal_px: 900", "one of fov_deg and focal_px"),
        ("fov_deg: 190", "1 to 170"),
        ("focal_px: -3", "focal lengths"),
        ("fov_deg: 75, colour: 3", "`colour`.*known fields: "),
        ("model: nikon", "catalogue has no camera 'nikon'"),
        ("model: rpi-3, focal_mm: 6", "can't be changed"),
    ],
)
def test_a_broken_plan_names_the_camera(tmp_path: Path, change: str, fault: str):
    text = (ROOT / "configs" / "plan.yaml").read_text().replace("fov_deg: 75", change, 1)
    (tmp_path / "plan.yaml").write_text(text)
    with pytest.raises(ConfigError, match=fault) as error:
        load_yaml(tmp_path / "plan.yaml", Plan)
    assert "north" in str(error.value)


def test_a_grid_covers_its_box_with_about_the_given_number_of_points():
    volume = Volume.covering((0.0, 0.0, 0.1), (6.0, 4.0, 1.6), 2000)
    assert (volume.x[0], volume.x[-1], volume.z[0], volume.z[-1]) == (0.0, 6.0, 0.1, 1.6)
    assert len(volume.points) == np.prod(volume.shape)
    assert 500 < len(volume.points) <= 2000
    assert volume.points[1].tolist() == [volume.x[1], volume.y[0], volume.z[0]]
    flat = Volume.covering((0.0, 0.0, 0.1), (1.0, 1.0, 0.1), 100)
    assert flat.z.tolist() == [0.1]
    assert flat.cell_m[2] == 0.0


def test_regions_are_connected_and_ordered_by_size():
    volume = Volume.covering((0.0, 0.0, 0.0), (1.0, 1.0, 0.0), 36)
    inside = np.zeros(volume.shape, bool)
    inside[0, 0, :3] = inside[0, -1, -1] = True
    large, small = find_regions(volume, inside.ravel())
    assert large.share == pytest.approx(3 * small.share)
    assert small.low.tolist() == [1.0, 1.0, 0.0]
    assert large.describe().startswith("x 0.00 to ")
