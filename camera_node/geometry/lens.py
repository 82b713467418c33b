# SPDX-License-Identifier: BSD-3-Clause
"""The lens: the only code that knows distortion. Pixel (0, 0) is the centre of the top-left pixel."""

from pathlib import Path
from typing import Literal, Self

import cv2
import msgspec
import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike

from camera_node.arrays import Array
from camera_node.config import load_yaml
from camera_node.errors import ConfigError

MAX_FISHEYE_DEG = 89.0  # from the axis: beyond, x/z and y/z run away


class Lens(msgspec.Struct, frozen=True, kw_only=True):
    """Intrinsics of a camera, in OpenCV's models and order.

    `distortion` holds k1, k2, p1, p2, k3, ... of OpenCV's pinhole model (0, 4, 5, 8, 12 or 14 numbers), or the four of
    `cv2.fisheye`. `fx fy cx cy` are pixels.
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
            raise ValueError(f"an image of {self.width} x {self.height} pixels is not possible")
        if not (self.fx > 0 and self.fy > 0):
            raise ValueError("the focal lengths fx and fy must be above 0 pixels")
        if not np.isfinite([self.fx, self.fy, self.cx, self.cy, *self.distortion]).all():
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
        """Raw pixels (N, 2) of points (N, 3) in the camera frame, metres; NaN for points not before the camera."""
        points = np.asarray(points, float).reshape(-1, 3)
        before = points[:, 2] > 1e-9
        uv = np.full((len(points), 2), np.nan)
        if before.any():
            uv[before] = self._project(points[before])[0]
        return uv

    def project_with_jacobian(self, points: ArrayLike) -> tuple[Array, Array]:
        """Raw pixels (N, 2), and their derivative (N, 2, 3) by the points (N, 3) of the camera frame.

        Points not before the camera have NaN in both.
        """
        return self.project_with_jacobians(points)[:2]

    def project_with_jacobians(self, points: ArrayLike) -> tuple[Array, Array, Array]:
        """As `project_with_jacobian`, and the derivative (N, 2, 4 + D) by the lens's own `parameters`."""
        points = np.asarray(points, float).reshape(-1, 3)
        before = points[:, 2] > 1e-9
        shapes = ((2,), (2, 3), (2, 4 + len(self.distortion)))
        uv, J_point, J_lens = (np.full((len(points), *shape), np.nan) for shape in shapes)
        if before.any():
            uv[before], J_point[before], J_lens[before] = self._project(points[before])
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
        # At zero rotation, moving the frame and moving the point are the same.
        return uv.reshape(-1, 2).astype(float), jacobian[:, :, translation], jacobian[:, :, lens]

    def normalise(self, uv: ArrayLike) -> Array:
        """Undistorted image plane coordinates x/z, y/z (N, 2) of raw pixels (N, 2).

        NaN where the distortion has no inverse (far outside the image), or the ray is not before the camera.
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
        """Newton's method on theta_d = theta (1 + k1 theta^2 + ... + k4 theta^8) (Kannala and Brandt 2006).

        `cv2.fisheye.undistortPoints` gives up where theta_d is above 90 degrees, though theta is not.
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

    def rays(self, uv: ArrayLike) -> Array:
        """Unit viewing rays (N, 3), camera frame, of raw pixels (N, 2)."""
        xy = self.normalise(uv)
        rays = np.column_stack([xy, np.ones(len(xy))])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


class _Lenses(msgspec.Struct):
    cameras: dict[str, Lens]


def load_lens(path: Path, name: str) -> Lens:
    """The lens of camera `name` in a rig file; whatever else the file says is left to `calib`.

    Raises:
        ConfigError: the file is missing or broken, or holds no such camera.
    """
    cameras = load_yaml(path, _Lenses).cameras
    if name not in cameras:
        raise ConfigError(f"{path} has no camera '{name}'; it has {', '.join(sorted(cameras)) or 'none'}")
    return cameras[name]
