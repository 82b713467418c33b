# SPDX-License-Identifier: BSD-3-Clause
"""What a person is told: precision that is honest, coverage in words, and a grade that names the guilty camera."""

from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from calib.errors import CalibrationError
from calib.rig.camera import PER_CAMERA, POSE
from calib.rig.coverage import Coverage, cell_centres, enumerate_words, region_of
from calib.rig.precision_map import FloorGrid, map_precision
from calib.rig.precision_plot import draw_precision
from calib.rig.triangulation import JointCovariance, camera_jacobians, point_covariances, triangulate_point
from calib.wand.bundle_adjustment.problem import State
from calib.wand.calibrate import calibrate
from calib.wand.outcome import WandCalibration
from calib.wand.quality.grade import GRADES, LIMITS, CameraQuality, RigQuality, assess, grade
from tests.calib.synthetic import record, ring
from tests.calib.wand.quality.test_agreement import covariance, disturb

ALL = np.ones((4, 6), bool)


@cache
def calibrated() -> WandCalibration:
    arena = ring(4)
    return calibrate(arena.intrinsics, arena.wand, record(arena, 8.0, sigma_px=0.1))


def test_expected_errors_are_honest():
    """Rigs that are wrong as their joint covariance says, pixels as their noise: squared Mahalanobis errors of a point
    in each of 200 rigs follow chi-square with 3 degrees."""
    rng, total, runs = np.random.default_rng(0), 0.0, 200
    cameras = list(ring(4).truth.cameras.values())
    C = covariance(4, rng)
    for _ in range(runs):
        point = rng.uniform([-0.8, -0.8, 0.1], [0.8, 0.8, 1.0])
        off = (np.linalg.cholesky(C) @ rng.standard_normal(24)).reshape(-1, 6)
        uv = [_see(camera.matrix(), camera, xi, point) for camera, xi in zip(cameras, off, strict=True)]
        error = triangulate_point(cameras, np.array(uv) + 0.1 * rng.standard_normal((4, 2))) - point
        total += float(
            error
            @ np.linalg.solve(point_covariances(cameras, point, 0.1, JointCovariance(POSE, C))[0], error)
        )
    low, high = chi2.ppf([0.001, 0.999], 3 * runs)
    assert low < total < high


def _see(T, camera, xi, point):
    """The pixel of a point in a camera that stands a little elsewhere."""
    world = disturb(T[None], xi, np.random.default_rng(0))[0]
    home = disturb(T[None], np.zeros(6), np.random.default_rng(0))[0]
    moved = T @ np.linalg.inv(home) @ world
    return camera.project((point - moved[:3, 3]) @ moved[:3, :3])[0]


def test_the_camera_s_jacobians_are_those_of_the_adjustment():
    """What a step of the adjustment's state does to a pixel, by central differences: in the same order and sense."""
    camera = next(iter(ring(2).truth.cameras.values()))
    rng, h = np.random.default_rng(1), 1e-6
    points = np.column_stack([rng.uniform(-1, 1, (5, 2)), rng.uniform(2, 4, 5)])
    everything = tuple(range(PER_CAMERA))
    J = camera_jacobians(camera, points, everything)
    state = State.of(np.eye(4)[None], np.zeros(1), np.zeros((2, 2, 1, 3)))

    def see(step):
        moved = state.retract(step[None], np.zeros(12))
        T = moved.cameras[0]
        return moved.lens(0, camera).project((points - T[:3, 3]) @ T[:3, :3])

    for k, step in enumerate(h * np.eye(PER_CAMERA)):
        assert J[:, :, k] == pytest.approx((see(step) - see(-step)) / (2 * h), abs=1e-3)


def test_parallel_rays_fix_no_point():
    camera = next(iter(ring(2).truth.cameras.values()))
    with pytest.raises(CalibrationError, match="parallel"):
        triangulate_point([camera, camera], [[400, 300], [400, 300]])
    assert np.isinf(point_covariances([camera], [[0, 0, 0.5]], 0.1)).all()


def test_a_map_tells_where_it_is_good_and_where_nobody_sees():
    cameras = ring(4).truth.cameras
    told = map_precision(list(cameras.values()), FloorGrid.covering([-15, -15], [15, 15], 0.1))
    middle = told.sigma_mm[np.ix_(np.abs(told.grid.y) < 2.5, np.abs(told.grid.x) < 2.5)]
    assert np.isfinite(middle).all()
    assert middle.max() < 3  # 0.1 px at 5 m and 520 px is 1 mm a camera
    assert np.isinf(told.sigma_mm[0, 0])
    assert 0 < told.covered < 1
    lines = told.lines()
    assert len(lines) == len(told.grid.y) + 2
    assert "·" in lines[1]
    picture = draw_precision(told, cameras)
    assert picture.ndim == 3
    assert (picture != picture[0, -1]).any(axis=2).mean() > 0.2


def test_coverage_is_told_in_words():
    """Points in the right half only: the left third is missing, its corners first."""
    width, height = 640, 480
    uv = cell_centres(width, height, (6, 8))
    coverage = Coverage.of(uv[uv[:, 0] > 300], width, height)
    assert coverage.share() == pytest.approx(0.5)
    assert set(coverage.missing()) == {"upper left", "left", "lower left"}
    left = np.broadcast_to(np.arange(8) < 4, (6, 8))
    assert coverage.share(~left) == 1
    assert coverage.missing(~left) == []
    assert region_of([630, 470], width, height) == "lower right"
    assert Coverage.of([[-1, 5], [np.nan, 5], [640, 5]], width, height).counts.sum() == 0
    assert enumerate_words(["a", "b", "c"]) == "a, b and c"


def test_a_good_wave_is_judged():
    """Noise of 0.1 px: nothing but coverage, which 8 s leave open, and lenses, which have no figures, may keep it from
    A; places are expected to millimetres."""
    trust = assess(calibrated(), ring(4).wand)
    for camera in trust.cameras:
        assert {name for name, value in camera.figures.items() if grade(name, value) != "A"} <= {
            "unused",
            "pose_px",
        }
        assert grade("pose_px", camera.figures["pose_px"]) == "A" or camera.lens
        assert camera.figures["residual_px"] == pytest.approx(0.1 * np.sqrt(2), rel=0.3)
    assert trust.expected is not None
    assert 0.2 < trust.expected.typical_mm < 4
    told = trust.as_dict()
    assert told["grade"] in "ABC"
    assert set(told["trust"]) == {"cam0", "cam1", "cam2", "cam3"}


def judged(name: str, **figures: float) -> CameraQuality:
    good = {"residual_px": 0.1, "rejected": 0.0, "pose_px": 0.02, "unused": 0.1}
    return CameraQuality(name, Coverage(np.ones((4, 6), np.int64)), ALL, good | figures)


@pytest.mark.parametrize(
    ("criterion", "says"),
    [
        ("residual_px", "residual"),
        ("rejected", "rejected"),
        ("pose_px", "its place"),
        ("unused", "not waved"),
    ],
)
def test_the_guilty_camera_is_named(criterion: str, says: str):
    for k, limit in enumerate(LIMITS[criterion]):
        trust = RigQuality([judged("good"), judged("bad", **{criterion: 1.01 * limit})], {}, 1e-4, None)
        assert trust.grade == GRADES[k + 1]
        assert f"camera 'bad', {says}" in trust.sentence() or says in trust.sentence()
        assert "'good'" not in trust.sentence()


def test_grades_of_the_whole():
    assert RigQuality([judged("a")], {}, 1e-4, None).sentence() == "grade A: every camera is placed well"
    told = RigQuality([judged("a")], {"b": "never saw the wand; wave before it"}, None, None).sentence()
    assert told == "grade D: camera 'b' has no place: never saw the wand; wave before it"
    assert "wand's length is 3.00% off" in RigQuality([judged("a")], {}, 0.03, None).sentence()
    assert RigQuality([judged("a", pose_px=float("nan"))], {}, None, None).grade == "D"
