# SPDX-License-Identifier: BSD-3-Clause
"""Combines the views of all cameras into the expected errors of tracked robots.

Tracking weighs each detection by the noise that its detector reports and a floor (`fusion`, `sigma_floor_px`), and
treats calibration and capture times as exact. With J the derivative of the pixels by the point, W the weights and S the
true covariance of a detection, the estimate has the covariance A^-1 B A^-1, A = sum J^T W J, B = sum J^T W S W J.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.plan.views import RoundelSensor
from calib.rig.camera import Camera, pixel_jacobians, transform
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.pose import invert, skew

FLOOR_PX = 0.05  # `sigma_floor_px` of fusion's limits; a test compares them
MIN_MARKERS = 3  # from which the orientation of a robot is determined by its markers' positions
TINY_PX = 1e-3  # keeps covariances regular
REGULAR_M = (
    100.0  # standard deviation of a position before any view; keeps the sums regular where nothing is seen
)


@dataclass(frozen=True, slots=True, eq=False)
class CombinedViews:
    """Sums over the views of N roundels.

    Attributes:
        information: (N, 3, 3) A, per square metre, world.
        spread: (N, 3, 3) B of errors that differ between the roundels of a robot.
        common: (N, 3, 3) B of errors that all roundels of a robot have in common: camera poses and capture times.
        count: (N,) number of cameras that detect the roundel.
    """

    information: Array
    spread: Array
    common: Array
    count: Index

    @classmethod
    def of_none(cls, n: int) -> "CombinedViews":
        """The sums without any view."""
        matrices = np.zeros((3, n, 3, 3))
        return cls(matrices[0], matrices[1], matrices[2], np.zeros(n, np.intp))

    def __add__(self, other: "CombinedViews") -> "CombinedViews":
        return CombinedViews(
            self.information + other.information,
            self.spread + other.spread,
            self.common + other.common,
            self.count + other.count,
        )


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedErrors:
    """Expected errors of robots at N points, from one frame set; infinite where fewer than two cameras see a robot.

    Attributes:
        position_mm: (N,) root mean square distance between a robot's position and the estimate.
        worst_axis_mm: (N,) standard deviation of the position along its worst axis.
        orientation_deg: (N,) root mean square angle; NaN for robots with fewer than three markers.
        cameras: (N,) number of cameras that detect the roundels.
    """

    position_mm: Array
    worst_axis_mm: Array
    orientation_deg: Array
    cameras: Index


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """What adds to the detector's noise: `sigma_px` of a coordinate of a centre, and `speed_m_s` of the robots, which
    turns errors of capture times into errors of position."""

    sigma_px: float
    speed_m_s: float


def combine_views(
    cameras: Mapping[str, Camera],
    sensors: Mapping[str, RoundelSensor],
    points: Array,
    uncertainty: Uncertainty,
) -> CombinedViews:
    """The sums over all cameras, for level roundels at points (N, 3), world, metres."""
    total = CombinedViews.of_none(len(points))
    for name, camera in cameras.items():
        total += weigh_view(camera, sensors[name], points, uncertainty)
    return total


def weigh_view(
    camera: Camera, sensor: RoundelSensor, points: Array, uncertainty: Uncertainty
) -> CombinedViews:
    """What one camera adds to the sums, for level roundels at points (N, 3), world, metres."""
    sums = CombinedViews.of_none(len(points))
    view = sensor.view(camera, points)
    J = view.jacobian
    weighted = np.linalg.inv(view.noise + FLOOR_PX**2 * np.eye(2)) @ J
    own = view.noise + uncertainty.sigma_px**2 * np.eye(2)
    common = _common_covariance(camera, points[view.rows], J, uncertainty.speed_m_s * sensor.stamp_sigma_s)
    sums.information[view.rows] = J.mT @ weighted
    sums.spread[view.rows] = weighted.mT @ own @ weighted
    sums.common[view.rows] = weighted.mT @ common @ weighted
    sums.count[view.rows] = 1
    return sums


def view_information(camera: Camera, sensor: RoundelSensor, points: Array, uncertainty: Uncertainty) -> Array:
    """(N, 3, 3) information J^T S^-1 J of one camera on level roundels at points (N, 3), world, per square metre.

    It is that of an estimator which knows the true covariances S. Sums of it rank placements of cameras.
    """
    information = np.zeros((len(points), 3, 3))
    view = sensor.view(camera, points)
    J = view.jacobian
    S = view.noise + uncertainty.sigma_px**2 * np.eye(2)
    S = S + _common_covariance(camera, points[view.rows], J, uncertainty.speed_m_s * sensor.stamp_sigma_s)
    information[view.rows] = J.mT @ np.linalg.inv(S + TINY_PX**2 * np.eye(2)) @ J
    return information


def expected_errors(sums: CombinedViews, markers: Array) -> ExpectedErrors:
    """The errors of robots with markers (M, 3), body frame, metres, whose roundels have these sums.

    A robot is small compared with the arena: all its markers have the sums of its position. The orientation about z is
    unknown; the result is that of a robot whose axes are those of the world.
    """
    known = sums.count >= 2
    A, spread, common = (x[known] for x in (sums.information, sums.spread, sums.common))
    G = np.stack([np.hstack([np.eye(3), -skew(marker)]) for marker in markers])  # marker by pose (M, 3, 6)
    if len(markers) < MIN_MARKERS:
        G = G[:, :, :3]
    total = G.sum(axis=0)
    H = np.einsum("mia,nij,mjb->nab", G, A, G) + np.eye(G.shape[2]) / REGULAR_M**2
    B = np.einsum("mia,nij,mjb->nab", G, spread, G) + total.T @ common @ total
    inverse = np.linalg.inv(H)
    cov = np.full((len(known), *H.shape[1:]), np.inf)
    cov[known] = inverse @ B @ inverse
    return _summarize(cov, sums.count)


def _summarize(cov: Array, count: Index) -> ExpectedErrors:
    known = np.isfinite(cov).all(axis=(1, 2))
    worst = np.full(len(cov), np.inf)
    worst[known] = 1e3 * np.sqrt(np.linalg.eigvalsh(cov[known][:, :3, :3])[:, -1])
    angle = np.full(len(cov), np.nan)
    if cov.shape[1] == 6:
        angle = np.degrees(np.sqrt(np.einsum("nii->n", cov[:, 3:, 3:])))
    position = 1e3 * np.sqrt(np.einsum("nii->n", cov[:, :3, :3]))
    return ExpectedErrors(position, worst, angle, count)


def _common_covariance(camera: Camera, points: Array, J: Array, motion_m: float) -> Array:
    """(N, 2, 2) covariance of centres by the camera's pose and by capture times, square pixels.

    The direction of the motion is unknown: a third of its square counts along each axis.
    """
    S = motion_m**2 / 3 * J @ J.mT
    if camera.covariance is not None:
        J_pose = pixel_jacobians(camera, transform(invert(camera.matrix()), points))[2]
        S = S + J_pose @ np.array(camera.covariance) @ J_pose.mT
    return S
