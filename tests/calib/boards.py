# SPDX-License-Identifier: BSD-3-Clause
"""Renders images of a ChArUco board through a known lens."""

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.intrinsics.board import make_charuco_board
from camera_node.foundation.arrays import Array
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import rotation_from_vector

LENS = Lens(
    width=640, height=480, fx=520.0, fy=523.0, cx=325.0, cy=236.0, distortion=(-0.12, 0.04, 0.0, 0.0, 0.0)
)
SPEC = "charuco:6x5:0.05:0.75:DICT_4X4_50"
SCALE = 1200  # board pixels a metre
Pose = tuple[NDArray, NDArray]


@cache
def pixel_rays() -> Array:
    """Viewing rays of half pixels, interpolated from a coarse grid."""
    v, u = np.mgrid[0:97, 0:129] * 10.0
    coarse = LENS.rays(np.column_stack([(u.ravel() - 0.5) / 2, (v.ravel() - 0.5) / 2])).reshape(97, 129, 3)
    x, y = np.meshgrid(np.arange(1280, dtype=np.float32) / 10, np.arange(960, dtype=np.float32) / 10)
    return cv2.remap(coarse, x, y, cv2.INTER_LINEAR).reshape(-1, 3).astype(float)


def render(turn: NDArray, shift: NDArray) -> NDArray[np.uint8]:
    """The board rotated by `turn`, with its centre at `shift`, seen through LENS; rendered at twice the size."""
    size = (int(0.3 * SCALE), int(0.25 * SCALE))
    picture = cv2.copyMakeBorder(make_charuco_board(SPEC).generateImage(size), 60, 60, 60, 60, 0, value=255)
    rays = pixel_rays()
    R = rotation_from_vector(turn)
    distance = (shift @ R[:, 2]) / (rays @ R[:, 2])
    on_board = (rays * distance[:, None] - shift) @ R[:, :2] + [0.15, 0.125]
    where = (on_board * SCALE - 0.5 + 60).astype(np.float32).reshape(960, 1280, 2)
    big = cv2.remap(picture, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderValue=128)
    return cv2.resize(big, (640, 480), interpolation=cv2.INTER_AREA).astype(np.uint8)


def board_poses(tilt: float, count: int = 16) -> list[Pose]:
    """Rotations and translations of the board, tilted in all directions."""
    rng = np.random.default_rng(3)
    return [
        (
            tilt * np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.2]),
            np.array([0.14 * np.cos(k), 0.1 * np.sin(1.7 * k), 0.55 + 0.1 * rng.random()]),
        )
        for k in range(count)
    ]
