# SPDX-License-Identifier: BSD-3-Clause
"""Camera intrinsics with lens distortion. Pixel (0, 0) is the centre of the top-left pixel."""

import math
from pathlib import Path
from typing import Literal, Self

import cv2
import msgspec
import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike

from camera_node.foundation.arrays import Array
from camera_node.foundation.config import load_yaml
from camera_node.foundation.errors import ConfigError

MAX_FISHEYE_DEG = 89.0  # from the axis; x/z and y/z diverge at 90 degrees


class Lens(msgspec.Struct, frozen=True, kw_only=True):
    """Intrinsics of a camera in OpenCV's models and order of parameters.

    `distortion` contains k1, k2, p1, p2, k3, ... of OpenCV's pinhole model (0, 4, 5, 8, 12 or 14 numbers) or k1 to k4
    of `cv2.fisheye`. `fx`, `fy`, `cx` and `cy` are in pixels.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    model: Literal["pinhole", "fisheye"] = "pinhole"

    def __post_init__(self) -> None:
        if not (0 < self.width <= 32768 and 0 < self.height <= 32768):
            raise ValueError(
                f"an image of {self.width} x {self.height} px is not possible; give 1 to 32768 px a side"
            )
        if not (self.fx > 0 and self.fy > 0):
            raise ValueError("the focal lengths fx and fy must be above 0 pixels")
        if not all(map(math.isfinite, (self.fx, self.fy, self.cx, self.cy, *self.distortion))):
            raise ValueError("intrinsics must be finite")
        allowed = (0, 4, 5, 8, 12, 14) if self.model == "pinhole" else (0, 4)
        if len(self.distortion) not in allowed:
            raise ValueError(
                f"a {self.model} lens takes {allowed} distortion numbers, got {len(self.distortion)}"
            )

    @property
    def K(self) -> Array:
        """(3, 3) camera matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def parameters(self) -> Array:
        """(4 + D,) fx, fy, cx, cy and the D distortion numbers."""
        return np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion])

    def with_parameters(self, parameters: ArrayLike) -> Self:
        """The same lens with other fx, fy, cx, cy and distortion numbers (4 + D,).

        Raises:
            ValueError: they are not finite, or a focal length is not above 0.
        """
        fx, fy, cx, cy, *distortion = np.asarray(parameters, float).tolist()
        changes = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": tuple(distortion)}
        lens = msgspec.structs.replace(self, **changes)
        lens.__post_init__()  # replace() does not call it
        return lens

    @property
    def _coefficients(self) -> Array:
        return np.array(self.distortion or (0.0,) * 4)

    def project(self, points: ArrayLike) -> Array:
        """Project points (N, 3), camera frame, to raw pixels (N, 2); NaN for points not in front of the camera."""
        points = np.asarray(points, float).reshape(-1, 3)
        front = points[:, 2] > 1e-9
        if len(points) and front.all():
            return self._project(points)[0]
        uv = np.full((len(points), 2), np.nan)
        if front.any():
            uv[front] = self._project(points[front])[0]
        return uv

    def project_with_jacobian(self, points: ArrayLike) -> tuple[Array, Array]:
        """Project points (N, 3), camera frame, to raw pixels (N, 2), with the derivatives (N, 2, 3) by the points.

        Both are NaN for points that are not in front of the camera.
        """
        return self.project_with_jacobians(points)[:2]

    def project_with_jacobians(self, points: ArrayLike) -> tuple[Array, Array, Array]:
        """As `project_with_jacobian`, with the derivatives (N, 2, 4 + D) by the lens's `parameters` in addition."""
        points = np.asarray(points, float).reshape(-1, 3)
        front = points[:, 2] > 1e-9
        if len(points) and front.all():
            return self._project(points)
        shapes = ((2,), (2, 3), (2, 4 + len(self.distortion)))
        uv, J_point, J_lens = (np.full((len(points), *shape), np.nan) for shape in shapes)
        if front.any():
            uv[front], J_point[front], J_lens[front] = self._project(points[front])
        return uv, J_point, J_lens

    def _project(self, points: Array) -> tuple[Array, Array, Array]:
        zero, free = np.zeros(3), 4 + len(self.distortion)
        if self.model == "fisheye":
            uv, jacobian = cv2.fisheye.projectPoints(points[None], zero, zero, self.K, self._coefficients)
            translation, lens = slice(11, 14), slice(0, free)
        else:
            uv, jacobian = cv2.projectPoints(points, zero, zero, self.K, self._coefficients)[:2]
            translation, lens = slice(3, 6), slice(6, 6 + free)
        jacobian = np.asarray(jacobian, float).reshape(len(points), 2, -1)
        # Without rotation, the derivatives by translation and by the point are equal.
        return uv.reshape(-1, 2).astype(float), jacobian[:, :, translation], jacobian[:, :, lens]

    def normalise(self, uv: ArrayLike) -> Array:
        """Undistort raw pixels (N, 2) to normalised image coordinates x/z, y/z (N, 2).

        NaN where the distortion has no inverse (far outside the image) or the ray does not point forward.
        """
        uv = np.asarray(uv, float).reshape(-1, 2)
        if len(uv) == 0:
            return np.empty((0, 2))
        if self.model == "fisheye":
            xy = self._normalise_fisheye(uv)
        else:
            criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-12)
            xy = cv2.undistortPoints(uv[:, None], self.K, self._coefficients, criteria=criteria)
            xy = xy.reshape(-1, 2).astype(float)
        back = self.project(np.column_stack([xy, np.ones(len(xy))]))
        xy[~(np.linalg.norm(back - uv, axis=1) < 1e-3)] = np.nan
        return xy

    def _normalise_fisheye(self, uv: Array) -> Array:
        """Solve theta_d = theta (1 + k1 theta^2 + ... + k4 theta^8) by Newton's method (Kannala and Brandt 2006).

        `cv2.fisheye.undistortPoints` fails where theta_d is above 90 degrees, although theta is not.
        """
        distorted = (uv - [self.cx, self.cy]) / [self.fx, self.fy]
        theta_d = np.linalg.norm(distorted, axis=1)
        odd = Polynomial(np.kron([1.0, *self._coefficients], [0.0, 1.0]))
        derivative = odd.deriv()
        theta = np.minimum(theta_d, np.pi / 2)
        for _ in range(20):
            step = (odd(theta) - theta_d) / np.maximum(derivative(theta), 0.1)
            theta = np.clip(theta - step, 0.0, np.pi / 2)
        stretch = np.where(theta_d > 1e-9, np.tan(theta) / np.maximum(theta_d, 1e-9), 1.0)
        stretch[theta > np.radians(MAX_FISHEYE_DEG)] = np.nan
        return stretch[:, None] * distorted

    def image_row(self, uv: ArrayLike) -> Array:
        """(N,) heights in the image of raw pixels (N, 2), from -1/2 at the upper edge to 1/2 at the lower one.

        A rolling shutter captures them this part of its readout time after the middle of the image.
        """
        return (np.asarray(uv, float).reshape(-1, 2)[:, 1] + 0.5) / self.height - 0.5

    def rays(self, uv: ArrayLike) -> Array:
        """Unit viewing rays (N, 3), camera frame, of raw pixels (N, 2)."""
        xy = self.normalise(uv)
        rays = np.column_stack([xy, np.ones(len(xy))])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


class _Lenses(msgspec.Struct):
    cameras: dict[str, Lens]


def load_lens(path: Path, name: str) -> Lens:
    """Read the lens of camera `name` from a rig file; `calib` reads the other fields of the file.

    Raises:
        ConfigError: the file is missing or invalid, or has no such camera.
    """
    cameras = load_yaml(path, _Lenses).cameras
    if name not in cameras:
        raise ConfigError(f"{path} has no camera '{name}'; it has {', '.join(sorted(cameras)) or 'none'}")
    return cameras[name]
