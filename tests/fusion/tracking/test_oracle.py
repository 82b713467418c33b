# SPDX-License-Identifier: BSD-3-Clause
"""One update of one robot, compared with GTSAM's own factors, lens model, derivatives and optimizer.

Both share only the input numbers. The problem is inverted: in the frame of the robot its markers are fixed landmarks
and the rig moves, so the unknown is the pose X = T_robot_world of the rig and each camera is a sensor on the rig, as
`GenericProjectionFactor` expects. The estimator has the pose of the robot, its own derivatives, and GTSAM for linear
elimination only. The discs are so small that they are points: GTSAM has no factor for the outline of a disc, which
other tests compare with sampled circles.
"""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from calib.rig.camera import Camera
from camera_node.detection.roundels import Roundels
from camera_node.geometry.pose import rotation_from_vector
from fusion._core import CAUCHY, NOMINAL_WEIGHT
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.observations import CameraArray, DetectionTable, Discs, MatchedObservations
from fusion.model.states import States
from fusion.tracking.estimator import Estimator, Prediction, _eliminate
from tests.fusion.synthetic import ring

CAMERAS = ring(distortion=(-0.1, 0.02, 0.0003, -0.0002))  # the terms of GTSAM's Cal3DS2
MARKERS = np.array([[0.15, 0.0, 0.0], [-0.13, 0.14, 0.02], [-0.03, -0.14, 0.05], [0.1, 0.1, 0.0]])
SIGMAS = (0.004, 0.002)  # of the prior: rad, m
X = gtsam.symbol("x", 0)


@pytest.mark.parametrize(("noise_px", "outliers"), [(0.2, 0), (0.2, 2)])
def test_the_estimator_agrees_with_a_graph_of_gtsam_factors(noise_px, outliers):
    """Both minimize the same robust cost. Measured difference: 1e-7 with an outlier of 3 px, whose distance in the
    undistorted plane is affine (1e-3 px with a weight of 0.1). The covariances differ to first order in the correction,
    which rotates the coordinates of the prior: half of 5e-3 rad, times the prior's share of the information, 1/5."""
    rng = np.random.default_rng(5)
    prior = predicted(rng)
    seen = observed(prior.states, rng, noise_px, outliers)
    R, p, P = oracle(prior.states, seen)
    estimator = Estimator(CameraArray(CAMERAS), np.full((1, 2), 10.0), np.array([False]))
    found, _ = estimator.update(prior, seen, 0.0)
    assert np.abs(found.p[0] - p).max() < 3e-7
    assert np.abs(found.R[0] - R).max() < 3e-7
    sigma = np.sqrt(np.diag(P))
    assert np.abs((found.P[0, :6, :6] - P) / np.outer(sigma, sigma)).max() < 1e-3


def predicted(rng: np.random.Generator) -> Prediction:
    """A robot at rest after so short a time that its pose keeps the isotropic covariance of the prior."""
    R, p = rotation_from_vector([0.1, -0.2, 0.7]), np.array([0.2, -0.1, 0.3])
    at = States.at_rest(R[None], p[None], (*SIGMAS, 1.0, 1.0))
    return Estimator(CameraArray(CAMERAS), np.full((1, 2), 10.0), np.array([False])).predict(
        at, np.array([1e-3])
    )


def observed(
    predicted: States, rng: np.random.Generator, noise_px: float, outliers: int
) -> MatchedObservations:
    """Every marker in every camera, for a robot about one sigma from the prediction; u is twice as noisy as v."""
    R = predicted.R[0] @ rotation_from_vector(SIGMAS[0] * rng.normal(size=3))
    p = predicted.p[0] + SIGMAS[1] * rng.normal(size=3)
    n, k = len(MARKERS), len(CAMERAS)
    cameras = [gtsam.PinholeCameraCal3DS2(*placed(camera)) for camera in CAMERAS.values()]
    uv = [camera.project(R @ marker + p) for camera in cameras for marker in MARKERS]
    cov = np.tile(noise_px**2 * np.array([[4.0, 0.0], [0.0, 1.0]]), (n, 1, 1))
    uv = np.array(uv) + rng.normal(size=(n * k, 2)) * noise_px * [2, 1]
    uv[:outliers] += 3.0
    frames = []
    for name, points in zip(CAMERAS, np.split(uv, k), strict=True):
        roundels = replace(Roundels.from_points(points, noise_px), cov=cov)
        frames.append(CalibratedFrame.measure(name, 0, roundels, CAMERAS[name]))
    discs = Discs(
        frame=np.repeat(np.arange(k), n),
        body=np.zeros(n * k, np.intp),
        marker=np.tile(np.arange(n), k),
        position=np.tile(MARKERS.T, k),
        normal=np.tile([[0.0], [0.0], [1.0]], n * k),
        radius=np.full(n * k, 1e-6),
    )
    return MatchedObservations.of_discs(
        DetectionTable.of(FrameSet(0, tuple(frames)), CameraArray(CAMERAS)), discs
    )


def placed(camera: Camera) -> tuple[gtsam.Pose3, gtsam.Cal3DS2]:
    """The pose and the lens model of a camera in GTSAM's types."""
    lens = gtsam.Cal3DS2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, *camera.distortion)
    return gtsam.Pose3(camera.matrix()), lens


def oracle(predicted: States, seen: MatchedObservations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R, p and the covariance (6, 6) of the rotation (robot frame) and of p (world frame)."""
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    T = gtsam.Pose3(gtsam.Rot3(predicted.R[0]), predicted.p[0])
    start.insert(X, T.inverse())
    graph.add(gtsam.PriorFactorPose3(X, T.inverse(), gtsam.noiseModel.Gaussian.Covariance(turned(predicted))))
    for k, marker in enumerate(MARKERS):
        start.insert(gtsam.symbol("m", k), marker)
        graph.add(gtsam.NonlinearEqualityPoint3(gtsam.symbol("m", k), marker))
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY / np.sqrt(NOMINAL_WEIGHT))
    cameras = [placed(camera) for camera in CAMERAS.values()]
    for row, (uv, cov) in enumerate(
        zip(seen.detections.uv.T, seen.detections.cov.transpose(2, 0, 1), strict=True)
    ):
        noise = gtsam.noiseModel.Gaussian.Covariance(NOMINAL_WEIGHT * cov)
        pose, lens = cameras[seen.discs.frame[row]]
        marker, robust = gtsam.symbol("m", row % len(MARKERS)), gtsam.noiseModel.Robust.Create(cauchy, noise)
        graph.add(gtsam.GenericProjectionFactorCal3DS2(uv, robust, X, marker, lens, pose))
    options = gtsam.LevenbergMarquardtParams()
    options.setRelativeErrorTol(1e-15)
    options.setAbsoluteErrorTol(1e-15)
    best = gtsam.LevenbergMarquardtOptimizer(graph, start, options).optimize()
    found = best.atPose3(X).inverse()
    J = by_robot(found)
    P = J @ gtsam.Marginals(graph, best).marginalCovariance(X) @ J.T
    return found.rotation().matrix(), found.translation(), P


def by_robot(T: gtsam.Pose3) -> np.ndarray:
    """(6, 6) derivative of the estimator's error by that of X, its inverse: (X exp(xi))^-1 = X^-1 exp(-Ad_X xi)."""
    J = -T.inverse().AdjointMap()
    J[3:] = T.rotation().matrix() @ J[3:]
    return J


def turned(predicted: States) -> np.ndarray:
    """(6, 6) covariance of the prior in the tangent space of X."""
    J = np.linalg.inv(by_robot(gtsam.Pose3(gtsam.Rot3(predicted.R[0]), predicted.p[0])))
    return J @ predicted.P[0, :6, :6] @ J.T


def test_a_body_whose_equations_are_singular_stays_and_the_others_do_not():
    """As one that wrong detections moved next to a camera: GTSAM refuses the equations of all."""
    regular = np.diag(np.linspace(1.0, 2.0, 12))
    singular = regular.copy()
    singular[-1, -1] = 0.0
    right = np.ones((3, 12))
    steps = _eliminate(np.stack([regular, singular, regular]), right)
    np.testing.assert_allclose(steps[[0, 2]], right[[0, 2]] / np.diag(regular))
    assert not steps[1].any()
