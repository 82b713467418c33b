# SPDX-License-Identifier: BSD-3-Clause
"""Surveyed cameras fix the world."""

import msgspec
import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.world.world_frame import align_cameras, move_rig, scale_rig
from camera_node.geometry.pose import rotation_from_vector
from tests.calib.synthetic import errors, ring


def test_alignment_inverts_any_rigid_motion():
    truth = ring(5).truth
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_vector([0.3, -1.2, 0.7]), [1.0, -2.0, 0.5]
    positions = {name: camera.matrix()[:3, 3] for name, camera in truth.cameras.items()}
    aligned, distances = align_cameras(move_rig(truth, T), positions)
    assert max(distances.values()) < 1e-9
    for name, camera in aligned.cameras.items():
        assert camera.matrix() == pytest.approx(truth.cameras[name].matrix(), abs=1e-9)
    assert errors(aligned, truth)[0] < 1e-9


def test_surveys_that_are_too_small_collinear_or_wrong_are_refused():
    truth = ring(4).truth
    positions = {name: camera.matrix()[:3, 3] for name, camera in truth.cameras.items()}
    with pytest.raises(CalibrationError, match="three or more"):
        align_cameras(truth, {name: positions[name] for name in ("cam0", "cam1")})
    with pytest.raises(CalibrationError, match="on a line"):
        align_cameras(truth, {f"cam{k}": [float(k), 0.0, 1.0] for k in range(4)})
    swapped = dict(zip(positions, [positions[n] for n in ("cam1", "cam0", "cam2", "cam3")], strict=True))
    with pytest.raises(CalibrationError, match="do not match"):
        align_cameras(truth, swapped)


def test_a_rig_without_scale_takes_that_of_the_survey():
    truth = ring(4).truth
    small = scale_rig(msgspec.structs.replace(truth, calibration={"metric": False}), 0.37)
    surveyed = {name: camera.matrix()[:3, 3] for name, camera in truth.cameras.items()}
    aligned, distances = align_cameras(small, surveyed)
    assert aligned.calibration["metric"]
    assert max(distances.values()) < 1e-9
