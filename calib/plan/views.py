# SPDX-License-Identifier: BSD-3-Clause
"""What one camera measures of level roundels at many points: whether it detects them, and how precisely.

A level disc of diameter d_o is an ellipse whose half axes are the singular values of d_o / 2 J [e_x e_y], with J the
derivative of the image by the point (the lens is taken as affine over one roundel). Detector noise comes from a table
over both axes, because `predict_precision` follows the edge of each roundel.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from calib.plan.camera_kind import CameraKind
from calib.plan.description import Plan
from calib.rig.camera import Camera, transform
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert
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
