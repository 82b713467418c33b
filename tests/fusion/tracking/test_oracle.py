# SPDX-License-Identifier: BSD-3-Clause
"""One instant of one robot, solved a second way: by GTSAM's own factors, lens, derivatives and optimiser.

Nothing of `fusion` but the numbers that go in is shared. The problem is turned round: seen from the robot, its markers
are fixed landmarks and the rig moves, so the unknown is the rig's pose X = T_robot_world and each camera is a sensor
that the rig carries. That is what `GenericProjectionFactor` is for. The estimator has the robot's pose, its own
derivatives, and GTSAM for linear elimination only. The discs are tiny, hence points: the shift of a disc's outline,
which GTSAM has no factor for, is tested elsewhere against sampled circles.
"""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from calib.rig.camera import Camera
from camera_node.detection.roundels import Roundels
from camera_node.geometry.pose import rotation_from_vector
from fusion._core import CAUCHY, NOMINAL_WEIGHT
from fusion.model.camera_array import CameraArray, Discs
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.observations import DetectionTable, MatchedObservations
from fusion.model.states import States
from fusion.tracking.estimator import Estimator, Prediction
from tests.fusion.synthetic import ring

CAMERAS = ring(distortion=(-0.1, 0.02, 0.0003, -0.0002))  # all that GTSAM's Cal3DS2 models
MARKERS = np.array([[0.15, 0.0, 0.0], [-0.13, 0.14, 0.02], [-0.03, -0.14, 0.05], [0.1, 0.1, 0.0]])
SIGMAS = (0.004, 0.002)  # of the prior: rad, m
X = gtsam.symbol("x", 0)


@pytest.mark.parametrize(("noise_px", "outliers"), [(0.2, 0), (0.2, 2)])
def test_the_estimator_agrees_with_a_graph_of_gtsams_own_factors(noise_px, outliers):
    """Both minimise the same robust cost (measured: to 1e-7 at an outlier of 3 px, whose distance in the undistorted
    plane is taken as affine: 1e-3 px of it, weighed by a tenth). The covariances differ by the first order of the
    correction, which turns the prior's coordinates: half of some 5e-3 rad, times the prior's share of the
    information, a fifth."""
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
    """A robot at rest, after a time so short that its pose keeps the prior's round covariance."""
    R, p = rotation_from_vector([0.1, -0.2, 0.7]), np.array([0.2, -0.1, 0.3])
    at = States.at_rest(R[None], p[None], (*SIGMAS, 1.0, 1.0))
    return Estimator(CameraArray(CAMERAS), np.full((1, 2), 10.0), np.array([False])).predict(
        at, np.array([1e-3])
    )


def observed(
    predicted: States, rng: np.random.Generator, noise_px: float, outliers: int
) -> MatchedObservations:
    """Every marker in every camera, of a robot about a sigma beside the prediction; noise along one axis is double."""
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
        radius=np.full(n * k, 1e-6),
    )
    return MatchedObservations.of_discs(
        DetectionTable.of(FrameSet(0, tuple(frames)), CameraArray(CAMERAS), 0.0), discs
    )


def placed(camera: Camera) -> tuple[gtsam.Pose3, gtsam.Cal3DS2]:
    """Where a camera is, and its lens, in GTSAM's types."""
    lens = gtsam.Cal3DS2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, *camera.distortion)
    return gtsam.Pose3(camera.matrix()), lens


def oracle(predicted: States, seen: MatchedObservations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R, p and the covariance (6, 6) of the turn in the robot's frame and of p in the world."""
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
    """(6, 6) the estimator's error by that of X, its inverse: (X exp(xi))^-1 = X^-1 exp(-Ad_X xi), p in the world."""
    J = -T.inverse().AdjointMap()
    J[3:] = T.rotation().matrix() @ J[3:]
    return J


def turned(predicted: States) -> np.ndarray:
    """(6, 6) the prior's covariance in the tangent space of X."""
    J = np.linalg.inv(by_robot(gtsam.Pose3(gtsam.Rot3(predicted.R[0]), predicted.p[0])))
    return J @ predicted.P[0, :6, :6] @ J.T
