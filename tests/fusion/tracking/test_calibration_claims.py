# SPDX-License-Identifier: BSD-3-Clause
"""Published poses claim the errors of the rig: over many calibrations and places, not along one run."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from calib.rig.camera import Camera
from calib.rig.camera_errors import ERRORS, error_covariance, with_errors
from camera_node.geometry.pose import Pose, rotation_from_vector
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.observations import CameraArray
from fusion.tracking.tracker import Tracker
from tests.benchmarks.fusion_load import START_NS, Load, Scene
from tests.fusion.synthetic import TRIANGLE, Arena, line, measured
from tests.fusion.tracks import poses_of, track

RIGS, FRAMES, HZ = 30, 8, 30.0
FALSE_ALARM = 1e-3  # of one test


def drawn(cameras: dict[str, Camera], rng: np.random.Generator) -> dict[str, Camera]:
    """True cameras, of which the given ones are a calibration with the covariance that they state."""
    covariance = error_covariance(list(cameras.values()))
    errors = rng.multivariate_normal(np.zeros(len(covariance)), covariance).reshape(-1, ERRORS)
    true = {}
    for error, (name, camera) in zip(errors, cameras.items(), strict=True):
        T = camera.matrix()
        T[:3, 3] += T[:3, :3] @ error[3:6]
        T[:3, :3] = T[:3, :3] @ rotation_from_vector(error[:3])
        true[name] = msgspec.structs.replace(camera, T_world_cam=Pose.from_matrix(T))
    return true


def stated(cameras: dict[str, Camera], rng: np.random.Generator) -> dict[str, Camera]:
    """Cameras that state a covariance of all, with cross terms as large as their own: errors of as many millimetres and
    tenths of a milliradian as a wand leaves, of three kinds each of which all cameras have, and of their own."""
    scale = np.array([2e-4] * 3 + [1e-3] * 3 + [0.0] * 2)
    kinds = rng.standard_normal((len(cameras), ERRORS, 3)) * scale[:, None] / 3**0.5
    L = np.concatenate([kinds.reshape(-1, 3), np.diag(np.tile(scale, len(cameras))) / 2], axis=1)
    return with_errors(cameras, L @ L.T)


def squared_error(load: Load, cameras: dict[str, Camera], rng: np.random.Generator) -> float:
    """Of the last position of a moving robot by cameras with errors, over its claim: chi-square with 3 degrees."""
    scene, (name, robot) = Scene(load), next(iter(load.bodies.items()))
    scene.cameras = CameraArray(drawn(cameras, rng))
    start = tuple(load.paths.at(0.0).p[0].tolist())
    robot = measured(robot, rng) if len(robot.markers) > 1 else robot
    tracker = Tracker(cameras, {name: msgspec.structs.replace(robot, start_m=start)})
    for seq in range(FRAMES):
        stamps = (seq + load.phases()) / HZ
        messages = [scene.detect(k, seq, float(t), rng) for k, t in enumerate(stamps)]
        frames = tuple(CalibratedFrame.of(message, cameras[message.camera]) for message in messages)
        tracker.track(FrameSet(START_NS + round(seq / HZ * 1e9), frames))
    assert tracker.table.tracked.all()
    error = tracker.table.states.p[0] - load.paths.at((FRAMES - 1) / HZ).p[0]
    return float(error @ np.linalg.solve(tracker.table.claimed[0, 3:6, 3:6], error))


@pytest.mark.parametrize(
    ("markers", "sigma_px", "states_errors"),
    [
        pytest.param(1, 0.1, True, marks=pytest.mark.ci),
        pytest.param(4, 0.1, False, marks=pytest.mark.ci),
        (4, 0.01, True),
    ],
    ids=["one marker", "four markers, of a rig that states nothing", "a precise detector"],
)
def test_the_errors_of_the_rig_are_claimed(markers: int, sigma_px: float, states_errors: bool):
    """The sum over rigs and places is chi-square with 3 degrees of freedom for each."""
    rng = np.random.default_rng(6)
    squares = []
    for seed in range(RIGS):
        load = Load(1, markers, 4, HZ, 0.5, 0.1, 0.0, sigma_px=sigma_px, crossing=True, seed=seed)
        cameras = stated(load.rig, rng) if states_errors else load.rig
        squares.append(squared_error(load, cameras, rng))
    low, high = chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 3 * RIGS)
    assert low < np.sum(squares) < high, np.mean(squares) / 3


@pytest.mark.parametrize("clock_sigma_s", [5e-4, 5e-3, 2e-2])
def test_a_covariance_is_positive_from_the_first_pose_on(clock_sigma_s: float):
    """The noise of the clock hides the errors of the rig: before, an acquired robot counted them as if it did not, and
    claimed less than nothing."""
    motion = line((0.1, -0.2, 0.3), (0.8, 0.3, 0.0), turn=(0, 0, 0.5))
    arena = Arena({"a": TRIANGLE}, {"a": motion}, sigma_px=0.1)
    frames = [replace(frame, clock_sigma_s=clock_sigma_s) for frame in arena.frames(6)]
    P = np.array([pose.covariance_matrix for pose in poses_of(track(arena, frames), "a")])
    assert len(P)
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    assert (np.linalg.eigvalsh(P / (sigma[:, :, None] * sigma[:, None])) > 0).all()
