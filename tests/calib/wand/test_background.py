# SPDX-License-Identifier: BSD-3-Clause
"""Points beside the wand, at unknown positions, make the cameras accurate where the wand is not waved."""

from functools import cache

import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.rig.camera import transform
from calib.rig.rig import Rig
from calib.rig.triangulation import triangulate_points
from calib.wand.bundle_adjustment.problem_setup import match_points
from calib.wand.calibrate import calibrate
from calib.wand.detections import gather
from calib.wand.wand_report import WandCalibration
from camera_node.detection.roundels import Roundels
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.body import Body
from camera_node.geometry.pose import rigid_motions, rotation_from_vector
from camera_node.protocol.messages import Detections
from tests.calib.mishaps import altered, repack
from tests.calib.synthetic import SHEET, assert_honest, camera_errors, ring, roughly

STICK = Body(diameter_m=0.05, markers=((0.0, 0.0, 0.0), (0.4, 0.0, 0.0)))
ROWS, PERIOD_NS = 60, 50_000_000
STILL, MOVING = 30, 2  # background points; those that move are elsewhere in every instant
SMALL = np.array([[0.4, 0.4, 0.6], [0.8, 0.8, 1.0]])  # where the wand is waved
WIDE = np.array([[-1.0, -1.0, 0.1], [1.0, 1.0, 1.6]])  # where the points are
SIGMA_PX = 0.3


def within(box: Array, count: int, rng: np.random.Generator) -> Array:
    """(count, 3) random points in a box (2, 3)."""
    return box[0] + (box[1] - box[0]) * rng.random((count, 3))


def capture(truth: Rig, t_ns: int, points: Array, numbers: Index, noise: Array) -> list[Detections]:
    """Images at a time of points (n, 3), world, with numbers (n,), in all C cameras, with noise (C, n, 2), pixels."""
    messages = []
    for (name, camera), off in zip(truth.cameras.items(), noise, strict=True):
        uv = camera.project_world(points) + off
        seen = camera.sees(uv)
        roundels = Roundels.from_points(uv[seen], SIGMA_PX, numbers[seen].astype(np.int32))
        header = {"camera": name, "width": camera.width, "height": camera.height}
        messages.append(Detections.pack(roundels, seq=0, t_ns=t_ns, **header))
    return messages


def record(truth: Rig, seed: int, sigma_px: float) -> tuple[list[Detections], list[Detections]]:
    """The stick at random poses in a small part of the volume, and the background points, simultaneous."""
    rng, wand, beside = np.random.default_rng(seed), [], []
    still, numbers = within(WIDE, STILL, rng), np.arange(STILL + MOVING)
    for k in range(ROWS):
        R, place = rotation_from_vector(rng.uniform(-2, 2, 3)), within(SMALL, 1, rng)
        noise = sigma_px * rng.standard_normal((len(truth.cameras), 2 + STILL + MOVING, 2))
        wand += capture(truth, k * PERIOD_NS, STICK.points @ R.T + place, np.arange(2), noise[:, :2])
        points = np.concatenate([still, within(WIDE, MOVING, rng)])
        beside += capture(truth, k * PERIOD_NS, points, numbers, noise[:, 2:])
    return wand, beside


def volume_errors(found: Rig, truth: Rig) -> Array:
    """(n,) errors of points in the whole volume, metres, that the found cameras triangulate from true pixels, after the
    best rigid motion."""
    points = within(WIDE, 200, np.random.default_rng(99))
    uv = np.array([camera.project_world(points) for camera in truth.cameras.values()])
    located = triangulate_points([found.cameras[name] for name in truth.cameras], uv)
    return np.linalg.norm(transform(rigid_motions(located, points), located) - points, axis=1)


@cache
def solved(with_background: bool, seed: int) -> tuple[Rig, WandCalibration]:
    """The truth, and a calibration with lenses as of a data sheet, 2 % off."""
    arena = ring(4, wand=STICK)
    wand, beside = record(arena.truth, seed, SIGMA_PX)
    rig = roughly(arena.intrinsics, SHEET, seed=seed)
    return arena.truth, calibrate(rig, STICK, wand, None, True, beside if with_background else ())


@pytest.mark.ci
@pytest.mark.parametrize("seeds", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_errors_far_from_the_wand_are_halved_and_claimed(seeds: int):
    """Poses have the errors that their covariance claims: within the 99.9 % range of chi-square."""
    alone, beside, results = [], [], []
    for seed in range(seeds):
        truth, result = solved(True, seed)
        results.append((result, truth))
        alone.append(volume_errors(solved(False, seed)[1].rig, truth))
        beside.append(volume_errors(result.rig, truth))
    assert np.mean(np.square(beside)) < np.mean(np.square(alone)) / 4
    assert_honest(results, exactly=True)


def test_points_and_their_residuals_are_reported():
    """An image has 2 coordinates with the noise of a detection; 3 of the 8 of a point in four cameras locate it."""
    report = solved(True, 0)[1].report.background
    assert report is not None
    assert STILL + 0.9 * MOVING * ROWS < report.points <= STILL + MOVING * ROWS
    assert report.rejected < 0.01
    assert report.residual_px == pytest.approx(SIGMA_PX * np.sqrt(2 * 5 / 8), rel=0.2)
    assert f"{report.points} positions of background points" in report.sentence()


def exchange(message: Detections, a: int, b: int) -> Detections:
    """The message with the numbers of two points exchanged."""
    seen, swap = message.unpack(), {a: b, b: a}
    return repack(message, altered(seen, id=np.array([swap.get(n, n) for n in seen.id.tolist()], np.int32)))


def test_without_noise_the_rig_is_exact_and_wrong_points_are_rejected():
    """The numbers of two points are exchanged in one camera, and those of two others in another."""
    arena = ring(4, wand=STICK)
    wand, beside = record(arena.truth, 0, 0.0)
    swapped = {"cam1": (3, 4), "cam2": (10, 11)}
    wrong = [exchange(message, *swapped.get(message.camera, (0, 0))) for message in beside]
    result = calibrate(arena.intrinsics, STICK, wand, None, True, wrong)
    shift, turn = camera_errors(result.rig, arena.truth)
    assert shift.max() < 1e-6
    assert turn.max() < 1e-6
    images = result.adjusted.problem.background.camera[~result.adjusted.background_used].tolist()
    assert {1, 2} <= set(images)
    assert len(images) <= 4 * 4  # all images of four points


def circle(t_s: float) -> Array:
    """(1, 3) a point on a circle of 0.5 m, once around in 4 s."""
    turn = 2 * np.pi * t_s / 4
    return np.array([[0.5 * np.cos(turn), 0.5 * np.sin(turn), 1.0]])


def test_moving_points_of_free_running_cameras_are_interpolated():
    """At 20 Hz, frames a third of a period apart and clocks 30 ms apart: all images of a position are those of one
    time. Velocities by central differences over h = 50 ms err by a sixth of h^2 times the third derivative, which moves
    the cubic by less than h times that; at the ends of a track they are one-sided. A metre at 2 m is 400 px."""
    truth = ring(3).truth
    cameras, offset_s, messages = list(truth.cameras.items()), 0.03 * np.arange(3), []
    for k, (name, camera) in enumerate(cameras):
        for seq in range(60):
            t_s = seq * 0.05 + k * 0.05 / 3
            stamp_ns = round((1 + t_s - offset_s[k]) * 1e9)
            one = Rig(cameras={name: camera})
            messages += capture(one, stamp_ns, circle(t_s), np.array([7]), np.zeros((1, 1, 2)))
    detections = gather(messages, list(truth.cameras), list(truth.cameras.values()))[1]
    start_s = min(message.t_ns for message in messages) * 1e-9 - 1
    true_s = detections.t_s + start_s + offset_s[detections.camera]
    points = match_points(detections, true_s, 0.125)
    assert len(points) > 50
    reference = [k for k in range(3) if np.isin(points.point, points.point[points.camera == k]).all()]
    times = np.unique(true_s[detections.camera == reference[0]])
    paths = [camera.project_world(np.concatenate([circle(t) for t in times])) for _, camera in cameras]
    away = np.full((len(points), len(times)), 0.0)
    for point, camera, uv in zip(points.point, points.camera, points.uv, strict=True):
        away[point] = np.maximum(away[point], np.linalg.norm(paths[camera] - uv, axis=1))
    limit_px = 0.05**3 / 6 * 0.5 * (np.pi / 2) ** 3 * 400
    at_ends_px = 0.05**2 / 8 * 0.5 * (np.pi / 2) ** 2 * 400
    off_px = np.sort(away.min(axis=1))
    assert off_px[:-4].max() < limit_px
    assert off_px.max() < at_ends_px + limit_px


def test_unusable_background_points_are_refused():
    arena = ring(2, wand=STICK)
    wand, beside = record(arena.truth, 0, SIGMA_PX)
    plain = [repack(m, Roundels.from_points(m.unpack().uv, SIGMA_PX)) for m in beside]
    with pytest.raises(CalibrationError, match=r"background points need numbers .* column marker"):
        calibrate(arena.intrinsics, STICK, wand, None, True, plain)
    other = capture(ring(3).truth, 0, circle(0.0), np.array([0]), np.zeros((3, 1, 2)))
    with pytest.raises(CalibrationError, match="camera 'cam2' of the background points is not in the rig"):
        calibrate(arena.intrinsics, STICK, wand, None, True, other)
