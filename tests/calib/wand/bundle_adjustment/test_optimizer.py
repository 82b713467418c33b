# SPDX-License-Identifier: BSD-3-Clause
"""The bundle adjustment: derivatives, disc centres, initial clocks, outliers, clocks and lenses."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from calib.rig.camera import DRIFT, LENS, NEAREST_M, OFFSET, PER_CAMERA, POSE, READOUT
from calib.rig.rig import Rig
from calib.wand.bundle_adjustment.disc_centres import displacement
from calib.wand.bundle_adjustment.problem import gauge_directions
from calib.wand.bundle_adjustment.residuals import (
    predict_markers,
    reprojection_errors,
    reprojection_jacobians,
)
from calib.wand.calibrate import calibrate
from calib.wand.detections import Timing, gather
from calib.wand.initial_rig import TwoViewGeometry
from calib.wand.labels import label
from calib.wand.trajectory import locate, position_weights, velocity_weights
from calib.wand.wand_report import WandCalibration
from camera_node.geometry.body import Body
from camera_node.geometry.pose import skew
from camera_node.protocol.messages import Detections
from tests.benchmarks.calibration_honesty import clock_error
from tests.calib.mishaps import altered, repack
from tests.calib.recordings import EPOCH_S, SimulatedRecording, WandScenario
from tests.calib.recordings import record as record_wave
from tests.calib.synthetic import assert_honest, camera_errors, clock_errors_ms, outlines, record, ring


@pytest.fixture(scope="module")
def recorded() -> SimulatedRecording:
    return record_wave(WandScenario(cameras=6, seconds=15.0, rate_hz=20.0, seed=3))


@pytest.fixture(scope="module")
def result() -> WandCalibration:
    """The calibration of three cameras."""
    arena = ring(3)
    return calibrate(arena.intrinsics, arena.wand, record(arena, 3.0, sigma_px=0.1))


def test_jacobians_are_those_of_the_residuals(result: WandCalibration):
    """Against central differences, whose error is of second order in the step: 1e-5 of the largest entry at most."""
    problem = result.adjusted.problem.with_free(POSE, OFFSET, DRIFT, READOUT, LENS)
    seen, state = result.observations, result.adjusted.state
    along = np.zeros((len(state.motion), state.motion[0].size))
    J = reprojection_jacobians(problem, seen, state, predict_markers(problem, seen, state))[1]
    for parameter, step in enumerate(
        [1e-6] * 6 + [1e-5, 1e-5, 1e-4, 1e-6, 1e-3, 1e-3, 1e-5, 1e-6, 1e-5, 1e-5, 1e-5]
    ):
        by = np.zeros((len(state.cameras), PER_CAMERA))
        by[:, parameter] = step
        there, here = (
            reprojection_errors(problem, seen, state.retract(sign * by, along, 0 * state.shape))
            for sign in (1, -1)
        )
        expected = -(there - here) / (2 * step)
        assert J[:, :, parameter] == pytest.approx(expected, abs=1e-3 * np.abs(expected).max() + 1e-6)


def test_gauge_directions_change_no_residual(result: WandCalibration):
    """Moves the cameras by `gauge_directions`, and the wand with them, by 1e-5: the rest is of second order, 1e-10
    times the 600 px of a radian."""
    problem, seen, state = result.adjusted.problem, result.observations, result.adjusted.state
    by = np.zeros((len(state.cameras), PER_CAMERA))
    for column, twist in zip(gauge_directions(state, POSE).T, np.eye(6), strict=True):
        by[:, :6] = 1e-5 * column.reshape(-1, 6)
        along = state.motion @ skew(1e-5 * twist[:3]).T
        along[:, 0] += 1e-5 * twist[3:]
        moved = state.retract(by, along.reshape(len(along), -1), 0 * state.shape)
        expected = reprojection_errors(problem, seen, state)
        assert reprojection_errors(problem, seen, moved) == pytest.approx(expected, abs=600 * 1e-10 * 10)


def test_velocity_is_the_derivative_of_position():
    """Against central differences, inside and outside the knots."""
    knot_s, t_s, step = np.array([0.0, 0.1, 0.25, 1.0]), np.array([-0.03, 0.02, 0.13, 0.2, 0.4, 1.02]), 1e-6
    place = locate(knot_s, t_s, 0.3)
    change = position_weights(knot_s, t_s + step, place) - position_weights(knot_s, t_s - step, place)
    assert velocity_weights(knot_s, t_s, place) == pytest.approx(change / (2 * step), abs=1e-6)
    assert place.inside.tolist() == [False, True, True, True, False, False]


def test_the_displacement_of_ellipse_centres_is_that_of_perspective():
    """Against ellipses through the images of rims: about D^2/4f sin t cos t, without distortion exactly."""
    lens = msgspec.structs.replace(ring(3).truth.cameras["cam0"], distortion=())
    points, tilt = np.array([[0.2, -0.1, 2.0], [0.0, 0.0, 1.5]]), np.radians(45)
    normals = np.array([[0.0, np.sin(tilt), -np.cos(tilt)], [np.sin(tilt), 0.0, -np.cos(tilt)]])
    uv = outlines(lens, points, normals, 0.06)[0]
    off = displacement(lens, points, normals, 0.06)
    assert off == pytest.approx(uv - lens.project(points), abs=1e-9)
    D = lens.fx * 0.12 / 1.5
    assert np.linalg.norm(off[1]) == pytest.approx(D**2 / (4 * lens.fx) / 2, rel=0.02)


def test_distortion_displaces_ellipse_centres():
    """By up to 0.1 px, of which a hundredth, of fourth order in the size, remains."""
    lens, rng = ring(3).truth.cameras["cam0"], np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-0.6, 0.6, 300), rng.uniform(-0.4, 0.4, 300), np.ones(300)])
    points *= rng.uniform(1.2, 4, (300, 1))
    normals = np.array([0.0, 0.0, -1.0]) + rng.uniform(-0.6, 0.6, (300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    uv = outlines(lens, points, normals, 0.06)[0]
    straight = displacement(msgspec.structs.replace(lens, distortion=()), points, normals, 0.06)
    off = uv - lens.project(points) - displacement(lens, points, normals, 0.06)
    assert np.linalg.norm(uv - lens.project(points) - straight, axis=1).max() > 0.05
    assert np.linalg.norm(off, axis=1).max() < 1e-3


def test_the_initial_clock_shifts_of_pairs_are_right(recorded: SimulatedRecording):
    """To 6 ms, from which the adjustment converges; a frame lasts 33 ms."""
    names = sorted(recorded.truth.cameras)
    lenses = [recorded.truth.cameras[n] for n in names]
    frames, seen = gather(recorded.messages, names, lenses)
    timing = Timing(frames.period_s())
    labelled, _ = label(frames, timing, seen, WandScenario().wand, lenses)
    pairs = TwoViewGeometry(labelled, lenses, WandScenario().wand, timing)
    shared = np.triu(pairs.count_shared(), 1)
    for a, b in np.argwhere(shared > 40):
        pair = pairs.relate(int(a), int(b))
        assert pair is not None
        expected = lenses[a].time_offset_ms - lenses[b].time_offset_ms
        assert pair.shift_s * 1e3 == pytest.approx(expected, abs=6)


@pytest.mark.ci
def test_missing_time_in_all_cameras_rejects_no_observation():
    """The stamps of all cameras skip 0.3 s: the wand's motion jumps, and observations that agree are used."""
    scenario = WandScenario(
        cameras=6, seconds=8.0, rate_hz=30.0, offset_ms=0, drift_ppm=0, free_running=False, outliers=0, seed=3
    )
    recorded = record_wave(scenario)
    first, cut = min(m.t_ns for m in recorded.messages), 300_000_000
    late = [m for m in recorded.messages if m.t_ns - first >= 3_000_000_000 + cut]
    early = [m for m in recorded.messages if m.t_ns - first < 3_000_000_000]
    closed = early + [msgspec.structs.replace(m, t_ns=m.t_ns - cut) for m in late]
    result = calibrate(recorded.intrinsics, scenario.wand, closed)
    assert len(result.names) == 6
    assert result.adjusted.used.mean() > 0.98
    assert not result.time_offset_ms.any()
    assert not result.time_sigma_ms.any()
    assert not result.drift_sigma_ppm.any()


@pytest.mark.ci
def test_clocks_and_lenses_are_adjusted_where_the_data_need_it(recorded: SimulatedRecording):
    """Offsets are right within four standard deviations and 0.3 ms; true lenses stay within four of theirs."""
    result = calibrate(recorded.intrinsics, WandScenario().wand, recorded.messages)
    off_ms = np.abs(clock_errors_ms(result, recorded.truth))
    assert (off_ms < np.minimum(4 * result.time_sigma_ms, 0.3)).all()
    assert (np.abs(result.adjusted.state.lenses) < 4 * result.adjusted.problem.lens_sigma).all()


def scale_focal(recorded: SimulatedRecording, name: str, factor: float) -> Rig:
    camera = recorded.intrinsics.cameras[name]
    wrong = msgspec.structs.replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
    return Rig(cameras={**recorded.intrinsics.cameras, name: wrong})


@pytest.mark.ci
def test_a_camera_that_the_recording_contradicts_is_named_and_left_out(recorded: SimulatedRecording):
    """The other cameras are within four reported standard deviations."""
    messages = [mirror(m) if m.camera == "cam01" else m for m in recorded.messages]
    result = calibrate(recorded.intrinsics, WandScenario().wand, messages)
    assert set(result.report.unplaced) == {"cam01"}
    assert "no pose explains them" in result.report.unplaced["cam01"]
    off_mm = 1e3 * camera_errors(result.rig, recorded.truth)[0]
    assert (off_mm < 4 * np.array([camera.sigma_mm for camera in result.report.cameras])).all()


@pytest.mark.ci
def test_half_of_the_lenses_may_be_wrong(recorded: SimulatedRecording):
    """Three of six focal lengths are 15 % to 20 % off: all cameras are placed, within the reported covariance."""
    wrong = dict(recorded.intrinsics.cameras)
    for name, factor in {"cam00": 1.15, "cam02": 0.85, "cam04": 1.2}.items():
        wrong[name] = scale_focal(recorded, name, factor).cameras[name]
    result = calibrate(Rig(cameras=wrong), WandScenario().wand, recorded.messages)
    assert len(result.names) == 6
    assert_honest([(result, recorded.truth)])


def mirror(message: Detections) -> Detections:
    roundels = message.unpack()
    uv = np.column_stack([message.width - 1 - roundels.uv[:, 0], roundels.uv[:, 1]])
    return repack(message, altered(roundels, uv=uv, angle_rad=-roundels.angle_rad))


def test_drift_is_estimated():
    """Clocks drift up to 50 ppm apart over a minute without an offset in its middle: drifts are right within four
    sigmas (Bonferroni over four cameras: wrong once in 4000) and there are no offsets."""
    scenario = WandScenario(cameras=4, rate_hz=15.0, offset_ms=0, seed=6)
    recorded = record_wave(scenario)
    result = calibrate(recorded.intrinsics, scenario.wand, recorded.messages)
    truth = np.array([recorded.drift_ppm[name] for name in result.names])
    assert not result.time_sigma_ms.any()
    assert (np.abs(result.drift_ppm - truth + truth.mean()) < 4 * result.drift_sigma_ppm).all()


@pytest.mark.ci
@pytest.mark.parametrize("seeds", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_the_covariance_of_time_offsets_that_drifts_extrapolate_is_right(seeds: int):
    """Two of four cameras see the wand in the first quarter only, so their offsets, which hold in the middle, follow by
    their drifts of up to 40 ppm: the squared Mahalanobis errors of the offsets, over all recordings, are between the
    0.1 % and 99.9 % quantiles of chi-square. With drifts fixed at zero they are 13 to 150 times the mean."""
    squared, degrees = 0.0, 0
    plain = WandScenario(
        cameras=4, seconds=40, rate_hz=15, drift_ppm=80, numbered=True, sized=False, both_sides=True
    )
    for seed in range(seeds):
        scenario = replace(plain, seed=seed)
        recorded, quarter_ns = record_wave(scenario), (EPOCH_S + 10) * 1e9
        early = [m for m in recorded.messages if m.camera in ("cam00", "cam01") or m.t_ns < quarter_ns]
        result = calibrate(recorded.intrinsics, scenario.wand, early)
        mean = clock_error(result, recorded.truth)
        assert mean is not None
        squared, degrees = squared + mean * (len(result.names) - 1), degrees + len(result.names) - 1
    assert chi2.ppf(0.001, degrees) < squared < chi2.ppf(0.999, degrees)


@pytest.mark.ci
@pytest.mark.parametrize("seeds", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_noise_gives_no_clock_parameters(seeds: int):
    """Three synchronized cameras, 15 s of a stick at 10 Hz, 1.5 px of noise, 5 % of gross errors: there are no offsets;
    an offset of 3 ms is estimated within four standard deviations. Schwarz's criterion has false positives: of ten
    seeds at 10 Hz and ten at 30 Hz, one gave a drift (seed 3 at 10 Hz)."""
    stick = Body(diameter_m=0.05, markers=((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)))
    scenario = WandScenario(
        cameras=3, arc=0.5, seconds=15, rate_hz=10, sigma_px=1.5, offset_ms=0, drift_ppm=0, wand=stick
    )
    scenario = replace(scenario, free_running=False, numbered=True, sized=False, both_sides=True)
    recordings = [record_wave(replace(scenario, seed=seed)) for seed in range(seeds)]
    for recorded in recordings:
        result = calibrate(recorded.intrinsics, stick, recorded.messages)
        assert not result.time_sigma_ms.any()
        assert not result.drift_sigma_ppm.any()
    early = [
        msgspec.structs.replace(m, t_ns=m.t_ns - 3_000_000) if m.camera == "cam01" else m
        for m in recordings[0].messages
    ]
    result = calibrate(recordings[0].intrinsics, stick, early)
    found = result.time_offset_ms[1] - result.time_offset_ms[[0, 2]].mean()
    assert found == pytest.approx(3.0, abs=4 * 1.5 * result.time_sigma_ms.max())  # of a mean of two


def test_a_marker_inside_a_camera_counts_as_behind_it(result: WandCalibration):
    """There it would fit any pixel, and its derivatives would be beyond double precision."""
    problem, seen, state = result.adjusted.problem, result.observations, result.adjusted.state
    for depth, is_known in ((0.5 * NEAREST_M, False), (2 * NEAREST_M, True)):
        T, motion = state.cameras[0], np.zeros_like(state.motion)
        motion[:, 0] = T[:3, 3] + depth * T[:3, 2]
        errors = reprojection_errors(problem, seen, replace(state, motion=motion))
        assert np.isfinite(errors[seen.camera == 0]).all() == is_known
