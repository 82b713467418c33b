# SPDX-License-Identifier: BSD-3-Clause
"""Triangulated points have the predicted covariance, with the uncertainty of the cameras."""

import numpy as np
import pytest
from scipy.stats import chi2

from calib.errors import CalibrationError
from calib.rig.camera import PER_CAMERA, POSE, Camera
from calib.rig.triangulation import JointCovariance, camera_jacobians, point_covariances, triangulate_point
from calib.wand.bundle_adjustment.problem import State
from camera_node.foundation.arrays import Array
from tests.calib.synthetic import disturb, random_covariance, ring


def test_the_covariance_of_points_is_honest():
    """200 rigs have random errors of their joint covariance, and pixels random noise: the squared Mahalanobis errors of
    a point in each follow chi-square with 3 degrees."""
    rng, total, runs = np.random.default_rng(0), 0.0, 200
    cameras = list(ring(4).truth.cameras.values())
    C = random_covariance(4, rng)
    for _ in range(runs):
        point = rng.uniform([-0.8, -0.8, 0.1], [0.8, 0.8, 1.0])
        off = (np.linalg.cholesky(C) @ rng.standard_normal(24)).reshape(-1, 6)
        uv = [_project_disturbed(camera, xi, point) for camera, xi in zip(cameras, off, strict=True)]
        error = triangulate_point(cameras, np.array(uv) + 0.1 * rng.standard_normal((4, 2))) - point
        cov = point_covariances(cameras, point, 0.1, JointCovariance(POSE, C))[0]
        total += float(error @ np.linalg.solve(cov, error))
    low, high = chi2.ppf([0.001, 0.999], 3 * runs)
    assert low < total < high


def _project_disturbed(camera: Camera, xi: Array, point: Array) -> Array:
    """Return the pixel of a point in a camera whose pose is disturbed by `xi` (6,)."""
    T = camera.matrix()
    world = disturb(T[None], xi, np.random.default_rng(0))[0]
    home = disturb(T[None], np.zeros(6), np.random.default_rng(0))[0]
    moved = T @ np.linalg.inv(home) @ world
    return camera.project((point - moved[:3, 3]) @ moved[:3, :3])[0]


def test_the_jacobians_of_a_camera_are_those_of_the_adjustment():
    """They equal central differences of a step of the adjustment's state, in order and sign."""
    camera = next(iter(ring(2).truth.cameras.values()))
    rng, h = np.random.default_rng(1), 1e-6
    points = np.column_stack([rng.uniform(-1, 1, (5, 2)), rng.uniform(2, 4, 5)])
    J = camera_jacobians(camera, points, tuple(range(PER_CAMERA)))
    state = State.of(np.eye(4)[None], np.zeros(1), np.zeros((2, 2, 1, 3)))

    def project(step: Array) -> Array:
        moved = state.retract(step[None], np.zeros(12), state.shape)
        T = moved.cameras[0]
        return moved.lens(0, camera).project((points - T[:3, 3]) @ T[:3, :3])

    for k, step in enumerate(h * np.eye(PER_CAMERA)):
        assert J[:, :, k] == pytest.approx((project(step) - project(-step)) / (2 * h), abs=1e-3)


def test_parallel_rays_give_no_point():
    camera = next(iter(ring(2).truth.cameras.values()))
    with pytest.raises(CalibrationError, match="parallel"):
        triangulate_point([camera, camera], [[400, 300], [400, 300]])
    assert np.isinf(point_covariances([camera], [[0, 0, 0.5]], 0.1)).all()
