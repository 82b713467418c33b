# SPDX-License-Identifier: BSD-3-Clause
"""The lens: the only code that knows distortion. Pixel (0, 0) is the centre of the top-left pixel."""

from pathlib import Path
from typing import Literal

import cv2
import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.config import load_yaml
from camera_node.errors import ConfigError

Array = NDArray[np.float64]


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
        points = np.asarray(points, float).reshape(-1, 3)
        before = points[:, 2] > 1e-9
        uv, J = np.full((len(points), 2), np.nan), np.full((len(points), 2, 3), np.nan)
        if before.any():
            uv[before], J[before] = self._project(points[before])
        return uv, J

    def _project(self, points: Array) -> tuple[Array, Array]:
        zero = np.zeros(3)
        if self.model == "fisheye":
            uv, jacobian = cv2.fisheye.projectPoints(points[None], zero, zero, self.K, self._coefficients)
            translation = slice(11, 14)
        else:
            uv, jacobian = cv2.projectPoints(points, zero, zero, self.K, self._coefficients)[:2]
            translation = slice(3, 6)
        # At zero rotation, moving the frame and moving the point are the same.
        return uv.reshape(-1, 2).astype(float), jacobian[:, translation].reshape(-1, 2, 3).astype(float)

    def normalise(self, uv: ArrayLike) -> Array:
        """Undistorted image plane coordinates x/z, y/z (N, 2) of raw pixels (N, 2).

        NaN where the distortion has no inverse (far outside the image).
        """
        uv = np.asarray(uv, float).reshape(-1, 1, 2)
        if len(uv) == 0:
            return np.empty((0, 2))
        if self.model == "fisheye":
            xy = cv2.fisheye.undistortPoints(uv, self.K, self._coefficients).reshape(-1, 2)
        else:
            criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-12)
            xy = cv2.undistortPoints(uv, self.K, self._coefficients, criteria=criteria).reshape(-1, 2)
        xy = xy.astype(float)
        back = self.project(np.column_stack([xy, np.ones(len(xy))]))
        xy[~(np.linalg.norm(back - uv[:, 0], axis=1) < 1e-3)] = np.nan
        return xy

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
