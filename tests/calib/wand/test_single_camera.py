# SPDX-License-Identifier: BSD-3-Clause
"""The recalibration of one camera of a rig: its pose, clock and covariance are right, the others stay."""

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from calib.errors import CalibrationError
from calib.rig.rig import Rig
from calib.wand.single_camera import recalibrate_camera
from tests.calib.recordings import SimulatedRecording, WandScenario, record
from tests.calib.synthetic import CAREFUL, roughly

NAME = "cam02"


@pytest.fixture(scope="module")
def recorded() -> SimulatedRecording:
    """Free-running cameras whose clocks are up to 150 ms apart and do not drift."""
    return record(WandScenario(cameras=6, seconds=8.0, rate_hz=30.0, drift_ppm=0.0, seed=3))


def without(rig: Rig, name: str) -> Rig:
    """The rig with a camera that has no pose."""
    bare = msgspec.structs.replace(rig.cameras[name], T_world_cam=None, time_offset_ms=0.0)
    return Rig(cameras={**rig.cameras, name: bare})


def test_the_covariance_of_a_recalibrated_camera_is_right(recorded: SimulatedRecording):
    """The squared Mahalanobis error of the pose is below the 99.9 % quantile of chi-square with 6 degrees. The lens is
    off by its standard deviations, half a pixel: 2 mm at 3 m."""
    lens = roughly(recorded.truth, CAREFUL, with_sigma=True).cameras[NAME]
    rig = without(Rig(cameras={**recorded.truth.cameras, NAME: lens}), NAME)
    found = recalibrate_camera(rig, WandScenario().wand, recorded.messages, NAME)
    here, there = found.rig.cameras[NAME], recorded.truth.cameras[NAME]
    D = np.linalg.inv(here.matrix()) @ there.matrix()
    error = np.array([D[2, 1], D[0, 2], D[1, 0], *D[:3, 3]])
    assert error @ np.linalg.solve(np.array(here.covariance), error) < chi2.ppf(0.999, 6)
    assert found.sigma_mm < 2
    assert here.time_offset_ms == pytest.approx(there.time_offset_ms, abs=4 * found.time_sigma_ms)
    assert found.time_sigma_ms < 0.3
    assert found.moved_mm is None
    assert all(found.rig.cameras[n] == c for n, c in recorded.truth.cameras.items() if n != NAME)


def test_the_distance_that_a_camera_moved_is_reported(recorded: SimulatedRecording):
    camera = recorded.truth.cameras[NAME]
    assert camera.T_world_cam is not None
    x, y, z = camera.T_world_cam.position_m
    pose = msgspec.structs.replace(camera.T_world_cam, position_m=(x + 0.05, y, z))
    moved = Rig(cameras={**recorded.truth.cameras, NAME: msgspec.structs.replace(camera, T_world_cam=pose)})
    found = recalibrate_camera(moved, WandScenario().wand, recorded.messages, NAME)
    assert found.moved_mm == pytest.approx(50, abs=5 * found.sigma_mm)


def test_faults_are_named(recorded: SimulatedRecording):
    wand, truth = WandScenario().wand, recorded.truth
    with pytest.raises(CalibrationError, match="'north' is not in the rig"):
        recalibrate_camera(truth, wand, recorded.messages, "north")
    others = [m for m in recorded.messages if m.camera != NAME]
    with pytest.raises(CalibrationError, match=f"'{NAME}' is not in the recording"):
        recalibrate_camera(truth, wand, others, NAME)
    alone = [m for m in recorded.messages if m.camera == NAME or m.t_ns % 8 == 9]
    with pytest.raises(CalibrationError, match=f"one camera, '{NAME}'"):
        recalibrate_camera(truth, wand, alone, NAME)
