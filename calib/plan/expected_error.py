# SPDX-License-Identifier: BSD-3-Clause
"""Expected errors of tracked robots: what each camera measures of level roundels, and the sum over all cameras.

Detection. A level disc of diameter d_o is an ellipse whose half axes are the singular values of d_o / 2 J [e_x e_y],
with J the derivative of the image by the point (the lens is taken as affine over one roundel). Detector noise comes
from a table over both axes, because `predict_precision` follows the edge of each roundel.

Estimate. Tracking weighs each detection by the noise that its detector reports and the calibration's error in the
image (`USUAL_PX`), and holds cameras and capture times fixed. With J the derivative of the pixels by the point,
W the weights and S the true covariance of a detection, the estimate has the covariance A^-1 B A^-1, A = sum J^T W J,
B = sum J^T W S W J.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from calib.plan.camera_kind import CameraKind
from calib.plan.description import Plan
from calib.rig.camera import Camera, pixel_jacobians, transform
from calib.rig.camera_errors import USUAL_PX
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert, skew
from camera_node.sensor_model.imaging import Imaging
from camera_node.sensor_model.operational_space import Pattern
from camera_node.sensor_model.precision import predict_precision
from camera_node.sensor_model.visibility import ImageOfDiscs, is_large_enough, lens_sees

MAJOR_PX = np.geomspace(5.0, 400.0, 24)  # full axes of the ellipses in the table
SLANT = np.linspace(0.08, 0.99, 16)  # minor over major axis
# The detector finds roundels that the image's border cuts: measured by `python -m tests.benchmarks.plan coverage` and
# `cut`, down to this distance of the centre from the border, in half extents, and with a standard deviation of the
# centre that grows as this power of its inverse.
LEAST_INSET, CUT_EXPONENT = 0.3, 1.3
NEAR_M = 0.01  # roundels nearer to the camera's plane are not seen
FOCAL_PX = 1000.0  # of the lens for which the table is computed; the precision in pixels hardly depends on it
MIN_MARKERS = 3  # from which the orientation of a robot is determined by its markers' positions
TINY_PX = 1e-3  # keeps covariances regular
# Standard deviation of a position before any view; keeps the sums regular where nothing is seen
REGULAR_M = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class RoundelView:
    """One camera's measurements of the K roundels that it detects.

    Attributes:
        rows: (K,) their rows among all roundels.
        jacobian: (K, 2, 3) pixels by the point, world.
        noise: (K, 2, 2) covariance of the ellipse's centre, of the detector alone, square pixels.
        axes_px: (K, 2) full major and minor axis.
    """

    rows: Index
    jacobian: Array
    noise: Array
    axes_px: Array


@dataclass(frozen=True, eq=False)
class RoundelSensor:
    """How a kind of camera sees the roundels of a plan.

    Attributes:
        pattern: the print.
        imaging: image quality and exposure time.
        speed_m_s: of the roundels, in unknown directions.
        min_diameter_px: smallest minor axis of a detected roundel; None for the measured limit of our detector.
        stamp_sigma_s: standard deviation of a capture time.
        found_share: share of the roundels at the limit of size that are found in a new image.
    """

    pattern: Pattern
    imaging: Imaging
    speed_m_s: float
    min_diameter_px: float | None
    stamp_sigma_s: float
    found_share: float

    @classmethod
    def of(cls, plan: Plan, kind: CameraKind) -> "RoundelSensor":
        """For cameras of one kind in a plan."""
        robots, image = plan.robots, plan.image
        pattern = Pattern.of(robots.diameter_m, robots.inner_ratio, robots.surround_ratio)
        return cls(
            pattern,
            image.imaging(kind.exposure_s),
            robots.speed_m_s,
            image.min_diameter_px,
            kind.stamp_sigma_s,
            image.found_share,
        )

    def view(self, camera: Camera, points: ArrayLike) -> RoundelView:
        """What a camera measures of level roundels at points (N, 3), world, metres."""
        T, points = camera.matrix(), np.asarray(points, float).reshape(-1, 3)
        local = transform(invert(T), points)
        rows = np.flatnonzero((T[2, 3] > points[:, 2]) & (local[:, 2] > NEAR_M) & lens_sees(camera, local))
        uv, J = camera.project_with_jacobian(local[rows])
        inside = camera.sees(uv)
        rows, uv, J = rows[inside], uv[inside], J[inside] @ T[:3, :3].T
        directions, axes = _axes(self.pattern.d_o / 2 * J[:, :, :2])
        inset = self._inset(camera, uv, J)
        detected = (inset >= LEAST_INSET) & self._is_large_enough(uv, axes)
        rows, J, inset = rows[detected], J[detected], inset[detected]
        directions, axes = directions[detected], axes[detected]
        variance = self.centre_variances(axes) * np.minimum(inset, 1.0)[:, None] ** (-2 * CUT_EXPONENT)
        return RoundelView(rows, J, (directions * variance[:, None]) @ directions.mT, axes)

    def centre_variances(self, axes_px: Array) -> Array:
        """(N, 2) variances of the centres of complete ellipses with axes (N, 2), along the major and the minor axis."""
        return self._table.look_up(axes_px)

    def _inset(self, camera: Camera, uv: Array, J: Array) -> Array:
        """(N,) distances of the centres uv (N, 2) from the nearest border of the image, in half extents of the discs.

        From 1 on a disc is completely in the image.
        """
        extent = np.linalg.norm(self.pattern.d_o / 2 * J[:, :, :2], axis=2)
        size = np.array([camera.width, camera.height])
        return (np.minimum(uv + 0.5, size - 0.5 - uv) / extent).min(axis=1)

    def _is_large_enough(self, uv: Array, axes: Array) -> Mask:
        """(N,) whether ellipses with centres and full axes (N, 2) are large enough for the detector."""
        if self.min_diameter_px is not None:
            return axes[:, 1] >= self.min_diameter_px
        motion = axes[:, 0] * self.speed_m_s * self.imaging.exposure_s / self.pattern.d_o
        slant = np.arccos(np.clip(axes[:, 1] / axes[:, 0], 0, 1))
        return is_large_enough(ImageOfDiscs(uv, axes, slant, motion), self.imaging, self.found_share)

    @cached_property
    def _table(self) -> "NoiseTable":
        return NoiseTable.of(self.pattern, self.imaging, self.speed_m_s)


@dataclass(frozen=True, slots=True, eq=False)
class NoiseTable:
    """Variances of an ellipse's centre along its major and its minor axis, by the axes' lengths.

    `log_variance` (2, M, S) at the major axes `MAJOR_PX` (M,) and the ratios of the axes `SLANT` (S,), square pixels.
    """

    log_variance: Array

    @classmethod
    def of(cls, pattern: Pattern, imaging: Imaging, speed_m_s: float) -> "NoiseTable":
        """For roundels that move at `speed_m_s` in unknown directions.

        Motion by m pixels during the exposure adds m^2 cos^2 / 12 to the squared blur of an edge, in the mean of all
        directions m^2 / 24. In pixels, m is the major axis times the motion in diameters.
        """
        motion = MAJOR_PX * speed_m_s * imaging.exposure_s / pattern.d_o
        rows = []
        for major, moved in zip(MAJOR_PX, motion, strict=True):
            blurred = replace(
                imaging, blur_px=float(np.hypot(imaging.blur_px, moved / np.sqrt(24))), exposure_s=0.0
            )
            rows.append(_centre_variances(pattern, blurred, major))
        return cls(np.log(np.stack(rows, axis=1)))

    def look_up(self, axes_px: Array) -> Array:
        """(N, 2) variances along the major and the minor axis, of ellipses with axes (N, 2); bilinear in logarithms."""
        major = np.clip(axes_px[:, 0], MAJOR_PX[0], MAJOR_PX[-1])
        ratio = np.clip(axes_px[:, 1] / np.maximum(axes_px[:, 0], 1e-9), SLANT[0], SLANT[-1])
        a = np.log(major / MAJOR_PX[0]) / np.log(MAJOR_PX[1] / MAJOR_PX[0])
        b = (ratio - SLANT[0]) / (SLANT[1] - SLANT[0])
        i, j = (np.minimum(x.astype(int), n - 2) for x, n in ((a, len(MAJOR_PX)), (b, len(SLANT))))
        a, b, table = a - i, b - j, self.log_variance
        low = (1 - b) * table[:, i, j] + b * table[:, i, j + 1]
        high = (1 - b) * table[:, i + 1, j] + b * table[:, i + 1, j + 1]
        return np.exp((1 - a) * low + a * high).T


def _centre_variances(pattern: Pattern, imaging: Imaging, major_px: float) -> Array:
    """(2, S) variances along the major and the minor axis of ellipses of one major axis and the ratios `SLANT`."""
    size = 2000
    lens = Lens(width=size, height=size, fx=FOCAL_PX, fy=FOCAL_PX, cx=size / 2, cy=size / 2)
    n = len(SLANT)
    position = np.tile([0.0, 0.0, FOCAL_PX * pattern.d_o / major_px], (n, 1))
    normal = np.column_stack([np.zeros(n), np.sqrt(1 - SLANT**2), -SLANT])  # slanted about the x axis
    cov = predict_precision(lens, pattern, position, normal, imaging).ellipse_cov_px
    return np.stack([cov[:, 0, 0], cov[:, 1, 1]])


def _axes(affine: Array) -> tuple[Array, Array]:
    """The axes of the images affine (N, 2, 2) of the unit circle, major first: directions (N, 2, 2), as columns, and
    full lengths (N, 2)."""
    U, half = np.linalg.svd(affine)[:2]
    return U, 2 * half


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
        orientation_deg: (N,) root mean square angle; NaN for robots with fewer than three markers.
        cameras: (N,) number of cameras that detect the roundels.
    """

    position_mm: Array
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
    weighted = np.linalg.inv(view.noise + USUAL_PX**2 * np.eye(2)) @ J
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
    angle = np.full(len(cov), np.nan)
    if cov.shape[1] == 6:
        angle = np.degrees(np.sqrt(np.einsum("nii->n", cov[:, 3:, 3:])))
    position = 1e3 * np.sqrt(np.einsum("nii->n", cov[:, :3, :3]))
    return ExpectedErrors(position, angle, count)


def _common_covariance(camera: Camera, points: Array, J: Array, motion_m: float) -> Array:
    """(N, 2, 2) covariance of centres by the camera's pose and by capture times, square pixels.

    The direction of the motion is unknown: a third of its square counts along each axis.
    """
    S = motion_m**2 / 3 * J @ J.mT
    if camera.covariance is not None:
        J_pose = pixel_jacobians(camera, transform(invert(camera.matrix()), points))[2]
        S = S + J_pose @ np.array(camera.covariance) @ J_pose.mT
    return S
