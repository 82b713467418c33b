# SPDX-License-Identifier: BSD-3-Clause
"""Calibration from a board that is rendered through a known lens recovers that lens."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from calib.errors import CalibrationError
from calib.intrinsics.board import (
    BoardFinder,
    CharucoFinder,
    ChessboardFinder,
    make_charuco_board,
    make_finder,
)
from calib.intrinsics.guided_capture import capture_views
from calib.intrinsics.images import read_frames
from calib.intrinsics.lens_adjustment import BoardView, adjust_lens
from calib.intrinsics.lens_calibration import (
    COEFFICIENTS,
    BoardViews,
    CalibratedLens,
    Model,
    aspect_ratio,
    merge_lenses,
)
from calib.intrinsics.residual_plot import draw_residuals
from calib.rig.camera import Camera
from calib.rig.rig import Rig, load_rig
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import rotation_from_vector
from tests.calib.boards import LENS, SPEC, Pose, board_poses, render

BOARD = ChessboardFinder(8, 6, 0.05)
SIDES = [
    (
        0.6 * np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.2]),
        np.array([0.3 * np.cos(k), 0.22 * np.sin(1.7 * k), 0.8 + 0.02 * (k % 5)]),
    )
    for k in range(24)
]  # rotations and translations of BOARD, all over the image


def see_through(model: Model) -> Lens:
    """A wide lens of a model, 800 x 600."""
    numbers = {"pinhole": (-0.15, 0.05, 0.0004, -0.0003, -0.01), "fisheye": (0.03, -0.01, 0.004, -0.001)}
    return Lens(
        width=800, height=600, fx=500.0, fy=500.5, cx=404.0, cy=296.0, distortion=numbers[model], model=model
    )


def look(lens: Lens, poses: list[Pose], sigma_px: float, seed: int = 0) -> list[BoardView]:
    """Views of BOARD through a lens, with noise; corners outside of the image are missing."""
    rng = np.random.default_rng(seed)
    views = []
    for k, (turn, shift) in enumerate(poses):
        uv = lens.project((BOARD.corners - BOARD.corners.mean(axis=0)) @ rotation_from_vector(turn).T + shift)
        uv = uv + sigma_px * rng.standard_normal(uv.shape)
        inside = ((uv > 0) & (uv < [lens.width, lens.height])).all(axis=1)
        views.append(BoardView(uv[inside].astype(np.float32), BOARD.corners[inside], f"{k}.png"))
    return views


def corners_of_the_image() -> list[Pose]:
    """Poses of the board near each corner and side of the image, slightly tilted."""
    return [
        (np.array([0.3 * v, -0.3 * u, 0.1 * u * v]), np.array([0.42 * u, 0.3 * v, 0.75]))
        for u in (-1, -0.5, 0, 0.5, 1)
        for v in (-1, 0, 1)
    ]


def name_all(images: list[NDArray[np.uint8]]) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    return ((f"{k}.png", image) for k, image in enumerate(images))


def calibrate_lens(
    name: str, images: Iterable[tuple[str, NDArray[np.uint8]]], finder: BoardFinder
) -> CalibratedLens:
    views = BoardViews(name, finder)
    for image_name, image in images:
        views.add(image_name, image)
    return views.solve()


def corner_rms(finder: CharucoFinder, images: list[NDArray[np.uint8]], poses: list[Pose]) -> float:
    """Root mean square reprojection error, pixels, of the detected corners for the true lens and poses."""
    squares = []
    for image, (turn, shift) in zip(images, poses, strict=True):
        if found := finder.find(image):
            corners = (found[1] - [0.15, 0.125, 0.0]) @ rotation_from_vector(turn).T + shift
            squares.append(((LENS.project(corners) - found[0]) ** 2).sum(axis=1))
    return float(np.sqrt(np.concatenate(squares).mean()))


def test_a_known_lens_is_recovered():
    """The truth is a candidate of least squares, so the residual is at most that of the truth: no tolerance. 16 views
    of corners to 0.15 px per coordinate fix the focal length to 0.5 %."""
    poses, finder = board_poses(0.6), CharucoFinder(make_charuco_board(SPEC))
    images = [render(*pose) for pose in poses]
    lens = calibrate_lens("cam0", name_all(images), finder)
    assert lens.rms_px < corner_rms(finder, images, poses)
    assert len(lens.views) >= 12
    assert lens.camera.fx == pytest.approx(LENS.fx, rel=0.005)
    assert lens.camera.fy == pytest.approx(LENS.fy, rel=0.005)
    assert (lens.camera.cx, lens.camera.cy) == pytest.approx((LENS.cx, LENS.cy), abs=2.5)
    grid = np.array([[u, v] for u in (80, 320, 560) for v in (60, 240, 420)], float)
    rays = LENS.rays(grid)
    assert np.abs(lens.camera.project(rays) - grid).max() < 4


def test_an_inverted_board_is_found():
    finder = CharucoFinder(make_charuco_board(SPEC))
    image = render(np.array([0.2, 0.1, 0.0]), np.array([0.0, 0.0, 0.5]))
    for picture in (image, cv2.bitwise_not(image).astype(np.uint8)):
        found = finder.find(picture)
        assert found is not None
        assert len(found[0]) == 20


@pytest.mark.parametrize("model", COEFFICIENTS)
def test_exact_without_noise(model: Model):
    """Only the prior causes an error: corners are exact, and the prior pulls the lens by 0.02 px."""
    lens = see_through(model)
    views = BoardViews("cam0", BOARD)
    views.views, views.size, views.frames = look(lens, SIDES, 0.0), (lens.width, lens.height), 24
    found = views.solve(model)
    assert found.rms_px < 2e-3
    grid = np.array([[u, v] for u in (80, 400, 720) for v in (60, 300, 540)], float)
    off = found.camera.project(lens.rays(grid)) - grid
    assert np.linalg.norm(off - off.mean(axis=0), axis=1).max() < 0.1


@pytest.mark.parametrize("model", ["pinhole", pytest.param("fisheye", marks=pytest.mark.ci)])
def test_the_covariance_of_the_lens_is_honest(model: Model):
    """Squared Mahalanobis errors of the parameters follow chi-square with 4 + D degrees each; the prior reduces them
    by next to nothing with 24 views."""
    truth, total, runs = see_through(model), 0.0, 12
    for seed in range(runs):
        views = look(truth, SIDES, 0.2, seed)
        adjusted = adjust_lens(truth, views)
        off = adjusted.lens.parameters - truth.parameters
        total += float(off @ np.linalg.solve(adjusted.covariance, off))
    low, high = chi2.ppf([0.001, 0.999], runs * len(truth.parameters))
    assert low < total < high


def test_bad_views_are_rejected_by_name():
    """Two views with motion blur, whose corners have noise of 5 px, are rejected, and the lens stays the same."""
    truth = see_through("pinhole")
    views = BoardViews("cam0", BOARD)
    good = look(truth, SIDES, 0.1)
    smeared = look(truth, SIDES[:2], 5.0)
    blurred = [replace(view, name=f"blur{k}") for k, view in enumerate(smeared)]
    views.views, views.size, views.frames = good + blurred, (truth.width, truth.height), 26
    found = views.solve()
    assert set(found.rejected) == {"blur0", "blur1"}
    assert found.camera.lens_sigma is not None
    assert found.camera.fx == pytest.approx(truth.fx, abs=4 * found.camera.lens_sigma[0])


def test_too_few_parallel_or_mixed_views_are_refused():
    finder = CharucoFinder(make_charuco_board(SPEC))
    with pytest.raises(CalibrationError, match="parallel views can't fix a lens; tilt"):
        calibrate_lens("cam0", name_all([render(*pose) for pose in board_poses(0.0, 8)]), finder)
    with pytest.raises(CalibrationError, match="the board is in no image"):
        calibrate_lens("cam0", name_all([np.zeros((48, 64), np.uint8)] * 9), finder)
    with pytest.raises(CalibrationError, match=r"1\.png: 64 x 49, before: 64 x 48"):
        calibrate_lens("cam0", name_all([np.zeros((48, 64), np.uint8), np.zeros((49, 64), np.uint8)]), finder)


def test_views_in_one_corner_are_refused_with_advice():
    """A distant board, well tilted, but always in the upper left."""
    truth = see_through("pinhole")
    views = BoardViews("cam0", BOARD)
    corner = [(turn, np.array([-1.5, -1.1, 2.4]) + 0.1 * np.sin(shift)) for turn, shift in SIDES]
    views.views, views.size, views.frames = look(truth, corner, 0.3), (truth.width, truth.height), 24
    with pytest.raises(CalibrationError, match=r"show it nearer.* of the image"):
        views.solve()


def test_a_chessboard_is_found():
    """The corners of a drawn chessboard are found to a tenth of a pixel; a partial view is not found."""
    finder = make_finder("chessboard:5x4:0.03")
    squares = np.kron(np.indices((5, 6)).sum(axis=0) % 2, np.ones((60, 60))) * 200 + 25
    image = cv2.copyMakeBorder(squares.astype(np.uint8), 80, 80, 80, 80, 0, value=225).astype(np.uint8)
    found = finder.find(image)
    assert found is not None
    pixels, corners = found
    assert len(pixels) == 20
    expected = corners[:, :2] / 0.03 * 60 + 80 + 60 - 0.5
    turned = 80 * 2 + np.array([360, 300]) - 1 - expected
    assert min(np.abs(pixels - expected).max(), np.abs(pixels - turned).max()) < 0.1
    assert finder.find(np.ascontiguousarray(image[:, :300])) is None


@pytest.mark.parametrize(
    "text", ["charuco:5by4", "chessboard:9x6", "chess:9x6:0.02", "charuco:5x4:0.05:2", "chessboard:9x2:0.02"]
)
def test_an_invalid_board_is_refused(text: str):
    with pytest.raises(ConfigError, match=f"--board {text} is not a board"):
        make_finder(text)


def test_a_capture_ends_when_the_views_suffice():
    """Repeated views are added once, and the capture ends well before the images do."""
    truth, shown = see_through("pinhole"), []
    everywhere = [*SIDES, *corners_of_the_image()]
    views = BoardViews("cam0", ViewReplay(look(truth, [p for p in everywhere for _ in range(2)] * 3, 0.05)))
    blank = np.zeros((truth.height, truth.width), np.uint8)
    images = ((f"snapshot {k}", blank) for k in range(6 * len(everywhere)))
    reason = capture_views(views, images, "pinhole", shown.append)
    assert reason.startswith("there are enough views")
    assert len(views.views) <= len(everywhere)
    assert len(shown) < 2 * len(everywhere) + 2
    counts = [progress.n_views for progress in shown]
    assert counts == sorted(counts)
    assert counts[-1] == len(views.views)
    assert shown[0].advice.startswith("show the board in the ")


def test_residuals_are_drawn():
    truth = see_through("pinhole")
    views = look(truth, SIDES, 0.2)
    residuals = np.concatenate(adjust_lens(truth, views).residuals)
    picture = draw_residuals(
        "cam0", truth, np.concatenate([view.pixels for view in views]).astype(float), residuals
    )
    assert picture.shape == (34 + 900, 1200, 3)
    assert (picture[34:] != picture[-1, -1]).any(axis=2).mean() > 0.01


@pytest.mark.ci
def test_lenses_of_webcams(shared_data: Callable[[str], Path]):
    """Real views of a distant board: the projection uncertainty covers the difference from another session's lens.
    Three sigmas of both; those of the other session are unknown and taken as equal: 3 sqrt(2) of ours, in the middle
    of the image."""
    folder = shared_data("webcams")
    other = load_rig(folder / "cameras.yaml").cameras["cam_0"]
    every_second = islice(read_frames(folder / "cam_0.mp4"), 0, None, 2)
    found = calibrate_lens("cam_0", every_second, make_finder("charuco:4x5:0.054"))
    assert found.rms_px < 0.2
    assert any("hardly in the" in warning for warning in found.warnings())
    middle = np.array([[u, v] for u in (480, 640, 800) for v in (240, 360, 480)], float)
    off = found.camera.project(other.rays(middle)) - middle
    off -= off.mean(axis=0)  # a rotation of the camera, which its pose absorbs
    assert np.linalg.norm(off, axis=1).max() < 3 * np.sqrt(2) * found.sigma_px[2:4, 3:5].max() * np.sqrt(2)


def test_merging_keeps_other_cameras():
    other = Camera(width=10, height=10, fx=9.0, fy=9.0, cx=5.0, cy=5.0)
    assert list(merge_lenses(Rig(cameras={"cam9": other}), {}, {}).cameras) == ["cam9"]


@pytest.mark.ci
def test_a_chessboard_under_uneven_light_is_found_as_precisely():
    """Twelve poses, in light that is too bright on one side of the image and dark on the other: the finder by sectors
    misses some, the fallback finds all of these, with corners as precise as its own on the others."""
    finder, errors = ChessboardFinder(8, 6, 0.05), {"sectors": [], "quadrangles": []}
    for k in range(12):
        image, truth = render_chessboard(finder, k)
        by_sectors = cv2.findChessboardCornersSB(
            image, (8, 6), flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
        )[0]
        found = finder.find(image)
        assert found is not None
        either = (truth, truth[::-1])  # the board looks the same turned by half a turn
        rms = min(np.sqrt(((found[0] - corners) ** 2).sum(axis=1).mean()) for corners in either)
        errors["sectors" if by_sectors else "quadrangles"].append(rms)
    assert len(errors["quadrangles"]) >= 2
    assert np.median(errors["quadrangles"]) < np.median(errors["sectors"])


def render_chessboard(finder: ChessboardFinder, k: int) -> tuple[NDArray[np.uint8], NDArray]:
    """A chessboard on grey under light from one side, 640 x 480, and its corners (48, 2), pixels."""
    turn = 0.6 * np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.2])
    shift = np.array([0.16 * np.cos(k), 0.12 * np.sin(1.7 * k), 0.8])
    R, focal, per_metre = rotation_from_vector(turn), 520.0, 1200.0
    picture = np.kron(np.indices((7, 9)).sum(axis=0) % 2, np.full((60, 60), 255)).astype(np.uint8)
    K = np.array([[2 * focal, 0, 639.5], [0, 2 * focal, 479.5], [0, 0, 1]])
    picture = cv2.copyMakeBorder(picture, 24, 24, 24, 24, 0, value=255)
    to_board = np.array([[1, 0, 0.5 - 294], [0, 1, 0.5 - 234], [0, 0, per_metre]]) / per_metre
    H = K @ np.column_stack([R[:, :2], shift]) @ to_board
    big = cv2.warpPerspective(picture, H, (1280, 960), borderValue=128)
    light = np.linspace(0.05, 1.95, 640)
    noise = np.random.default_rng(k).normal(0, 1.5, (480, 640))
    image = (
        cv2.GaussianBlur(cv2.resize(big, (640, 480), interpolation=cv2.INTER_AREA), (0, 0), 0.7) * light
        + noise
    )
    corners = (finder.corners - finder.corners.mean(axis=0)) @ R.T + shift
    return np.clip(image, 0, 255).astype(np.uint8), corners[:, :2] / corners[:, 2:] * focal + [319.5, 239.5]


@pytest.mark.parametrize("ratio", [1.0, 1.02])
def test_pixels_that_are_not_square_are_found_where_the_views_show_it(ratio: float):
    """fx / fy is within 4 standard deviations of the truth, and only pixels that are not square are warned of."""
    truth = see_through("pinhole")
    truth = truth.with_parameters(truth.parameters * [ratio, *[1.0] * 8])
    views = BoardViews("cam0", BOARD)
    views.views, views.size, views.frames = look(truth, SIDES, 0.1), (truth.width, truth.height), 24
    lens = views.solve()
    found, sigma = aspect_ratio(lens.adjusted)
    assert abs(found - truth.fx / truth.fy) < 4 * sigma
    assert any("not square" in warning for warning in lens.warnings()) == (ratio != 1.0)


@pytest.mark.parametrize("model", [pytest.param("pinhole", marks=pytest.mark.ci), "fisheye"])
def test_the_better_lens_model_is_suggested(model: Model):
    """Views through a very wide fisheye lens suggest it, and never the other."""
    lens = Lens(
        width=800, height=600, fx=280.0, fy=280.0, cx=400.0, cy=300.0, distortion=(0.0,) * 4, model="fisheye"
    )
    wide = [(turn, shift * [2.6, 2.6, 0.7]) for turn, shift in SIDES]
    views = BoardViews("cam0", BOARD)
    views.views, views.size = look(lens, wide, 0.1), (lens.width, lens.height)
    suggested = views.compare_models(model)
    assert ("run again with --model fisheye" in suggested) == (model == "pinhole")
    assert suggested == "" or model == "pinhole"
    views.views = look(see_through("pinhole"), SIDES, 0.1)
    assert views.compare_models("pinhole") == ""


def test_a_mirrored_board_is_reported():
    """By images in which the board is found only once they are mirrored, and by the order of its corners."""
    finder = CharucoFinder(make_charuco_board(SPEC))
    mirrored = [np.ascontiguousarray(render(*pose)[:, ::-1]) for pose in board_poses(0.6, 4)]
    with pytest.raises(CalibrationError, match="camera 'cam0': its images show the board mirrored"):
        calibrate_lens("cam0", name_all(mirrored), finder)
    truth = see_through("pinhole")
    views = BoardViews("cam0", BOARD)
    views.views = [
        replace(v, pixels=[truth.width - 1, 0] - v.pixels * [1, -1]) for v in look(truth, SIDES, 0.1)
    ]
    views.size, views.frames = (truth.width, truth.height), 24
    with pytest.raises(CalibrationError, match="mirrored"):
        views.solve()


class ViewReplay:
    """A finder that returns given views, one after the other."""

    def __init__(self, views: list[BoardView]) -> None:
        self._views = iter(views)

    def find(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        view = next(self._views)
        return view.pixels, view.corners
