# SPDX-License-Identifier: BSD-3-Clause
"""Surveyed cameras fix a world."""

from pathlib import Path

import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.world import align, move, read_positions
from camera_node.errors import ConfigError
from camera_node.pose import rotation_from_vector
from tests.calib.synthetic import errors, ring


def test_align_undoes_any_motion():
    truth = ring(5).truth
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_vector([0.3, -1.2, 0.7]), [1.0, -2.0, 0.5]
    places = {name: camera.matrix()[:3, 3] for name, camera in truth.cameras.items()}
    aligned, misses = align(move(truth, T), places)
    assert max(misses.values()) < 1e-9
    for name, camera in aligned.cameras.items():
        assert camera.matrix() == pytest.approx(truth.cameras[name].matrix(), abs=1e-9)
    assert errors(aligned, truth)[0] < 1e-9


def test_too_few_or_collinear_surveys_are_refused():
    truth = ring(4).truth
    places = {name: camera.matrix()[:3, 3] for name, camera in truth.cameras.items()}
    with pytest.raises(CalibrationError, match="three or more"):
        align(truth, {name: places[name] for name in ("cam0", "cam1")})
    with pytest.raises(CalibrationError, match="on a line"):
        align(truth, {f"cam{k}": [float(k), 0.0, 1.0] for k in range(4)})


@pytest.mark.parametrize(
    ("text", "fault"), [("camera,x,y\n", "lacks the column z"), ("camera,x,y,z\na,1,2,up\n", "line 2")]
)
def test_a_broken_survey_names_the_fault(tmp_path: Path, text: str, fault: str):
    path = tmp_path / "survey.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=fault):
        read_positions(path)
