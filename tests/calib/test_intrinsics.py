# SPDX-License-Identifier: BSD-3-Clause
"""A board rendered through a known lens gives that lens back."""

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib.board import BoardFinder, make_board
from calib.camera import Camera
from calib.errors import CalibrationError
from calib.intrinsics import calibrate_lens, merge
from calib.rig import Rig
from camera_node.lens import Lens
from camera_node.pose import rotation_from_vector

LENS = Lens(
    width=640, height=480, fx=520.0, fy=523.0, cx=325.0, cy=236.0, distortion=(-0.12, 0.04, 0.0, 0.0, 0.0)
)
SPEC = "charuco:6x5:0.05:0.75:DICT_4X4_50"
SCALE = 1200  # board pixels a metre


@cache
def pixel_rays() -> NDArray[np.float64]:
    """Viewing rays of half pixels, from a coarse grid."""
    v, u = np.mgrid[0:97, 0:129] * 10.0
    coarse = LENS.rays(np.column_stack([(u.ravel() - 0.5) / 2, (v.ravel() - 0.5) / 2])).reshape(97, 129, 3)
    x, y = np.meshgrid(np.arange(1280, dtype=np.float32) / 10, np.arange(960, dtype=np.float32) / 10)
    return cv2.remap(coarse, x, y, cv2.INTER_LINEAR).reshape(-1, 3).astype(float)


def render(turn: NDArray, shift: NDArray) -> NDArray[np.uint8]:
    """The board turned by `turn`, its middle at `shift`, seen through LENS; drawn at twice the size and reduced."""
    size = (int(0.3 * SCALE), int(0.25 * SCALE))
    picture = cv2.copyMakeBorder(make_board(SPEC).generateImage(size), 60, 60, 60, 60, 0, value=255)
    rays = pixel_rays()
    R = rotation_from_vector(turn)
    distance = (shift @ R[:, 2]) / (rays @ R[:, 2])
    on_board = (rays * distance[:, None] - shift) @ R[:, :2] + [0.15, 0.125]
    where = (on_board * SCALE - 0.5 + 60).astype(np.float32).reshape(960, 1280, 2)
    big = cv2.remap(picture, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderValue=128)
    return cv2.resize(big, (640, 480), interpolation=cv2.INTER_AREA).astype(np.uint8)


Pose = tuple[NDArray, NDArray]


def board_poses(tilt: float, count: int = 16) -> list[Pose]:
    """Turn and shift of the board, tilted to all sides."""
    rng = np.random.default_rng(3)
    return [
        (
            tilt * np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.2]),
            np.array([0.14 * np.cos(k), 0.1 * np.sin(1.7 * k), 0.55 + 0.1 * rng.random()]),
        )
        for k in range(count)
    ]


def corner_rms(finder: BoardFinder, images: list[NDArray[np.uint8]], poses: list[Pose]) -> float:
    """Root mean square distance, pixels, of the corners found from where the true lens and poses put them."""
    squares = []
    for image, (turn, shift) in zip(images, poses, strict=True):
        if found := finder.find(image):
            corners = (found[1] - [0.15, 0.125, 0.0]) @ rotation_from_vector(turn).T + shift
            squares.append(((LENS.project(corners) - found[0]) ** 2).sum(axis=1))
    return float(np.sqrt(np.concatenate(squares).mean()))


def test_a_known_lens_comes_back():
    """The truth is among what least squares may choose, so its residual is at most the truth's: no tolerance. 16 views
    of corners that are found to 0.15 px a coordinate fix the focal length to 0.5 %."""
    poses, finder = board_poses(0.6), BoardFinder(make_board(SPEC))
    images = [render(*pose) for pose in poses]
    lens = calibrate_lens("cam0", images, finder)
    assert lens.rms_px < corner_rms(finder, images, poses)
    assert lens.views >= 12
    assert lens.camera.fx == pytest.approx(LENS.fx, rel=0.005)
    assert lens.camera.fy == pytest.approx(LENS.fy, rel=0.005)
    assert (lens.camera.cx, lens.camera.cy) == pytest.approx((LENS.cx, LENS.cy), abs=2.5)
    grid = np.array([[u, v] for u in (80, 320, 560) for v in (60, 240, 420)], float)
    rays = LENS.rays(grid)
    assert np.abs(lens.camera.project(rays) - grid).max() < 4


def test_an_inverted_print_is_found():
    finder = BoardFinder(make_board(SPEC))
    image = render(np.array([0.2, 0.1, 0.0]), np.array([0.0, 0.0, 0.5]))
    for picture in (image, cv2.bitwise_not(image).astype(np.uint8)):
        found = finder.find(picture)
        assert found is not None
        assert len(found[0]) == 20


def test_views_that_fix_no_lens_are_refused():
    finder = BoardFinder(make_board(SPEC))
    with pytest.raises(CalibrationError, match="tilt it"):
        calibrate_lens("cam0", [render(*pose) for pose in board_poses(0.0, 8)], finder)
    with pytest.raises(CalibrationError, match="in 0 of 9 frames"):
        calibrate_lens("cam0", iter([np.zeros((48, 64), np.uint8)] * 9), finder)


def test_merging_keeps_other_cameras():
    other = Camera(width=10, height=10, fx=9.0, fy=9.0, cx=5.0, cy=5.0)
    assert list(merge(Rig(cameras={"cam9": other}), {}).cameras) == ["cam9"]
