# SPDX-License-Identifier: BSD-3-Clause
"""Clocks that depart are found with offset and rate within their claims; good clocks are left alone."""

import numpy as np
import pytest
from scipy.special import chdtri

from camera_node.detection.roundels import Roundels
from fusion.model.frames import CalibratedFrame
from fusion.monitoring.camera_clocks import CameraClocks
from fusion.rig_graph.clock_walk import (
    CHANGED_SIGMA,
    OFFSET_SIGMA_S,
    RATE_SIGMA,
    ClockWalk,
    Departure,
    other_offsets,
)
from fusion.rig_graph.hypotheses import CAUSES, ERRORS, FALSE_ALARM, FREE_SIGMA

WINDOW_S, SIGMA_S = 2.4, 1e-4  # between windows, and of an offset in one
START_NS = 10**18


def about_offsets(offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Equations of the cameras' errors by keyframes that show only the differences between the offsets."""
    n, H = len(offsets), np.zeros((len(offsets) * ERRORS,) * 2)
    clock = np.arange(n) * ERRORS + CAUSES["clock"].start
    H[np.ix_(clock, clock)] = (np.eye(n) - 1 / n) / SIGMA_S**2
    return H, H[:, clock] @ offsets


def first_departure(rates: list[float], seed: int, windows: int = 25) -> Departure | None:
    """Of clocks that drift at these rates, each window showing the differences of their offsets with noise."""
    rng, n = np.random.default_rng(seed), len(rates)
    walk = ClockWalk(n)
    for k in range(windows):
        offsets = np.array(rates) * k * WINDOW_S
        shown = offsets + SIGMA_S * rng.normal(size=n)
        walk.update(START_NS + round(k * WINDOW_S * 1e9), *about_offsets(shown))
        if found := walk.take_departures():
            return found[0]
    return None


@pytest.mark.parametrize("ppm", [50.0, -200.0, 2000.0])
@pytest.mark.parametrize("n_cameras", [3, 4, 8])
def test_a_clock_that_drifts_is_found_with_its_offset(ppm: float, n_cameras: int):
    deviations = []
    for seed in range(20):
        found = first_departure([ppm * 1e-6, *[0.0] * (n_cameras - 1)], seed)
        assert found is not None
        assert found.camera == 0
        deviations.append((found.offset_s - ppm * 1e-6 * (found.t_ns - START_NS) * 1e-9) / found.sigma_s)
    assert np.mean(np.square(deviations)) < 2.3  # chi-square with 20 degrees of freedom, one in a thousand


@pytest.mark.parametrize("n_cameras", [2, 3, 4, 8])
def test_good_clocks_are_left_alone(n_cameras: int):
    assert not any(first_departure([0.0] * n_cameras, seed) for seed in range(20))


def correction_s(clocks: CameraClocks, name: str, t_ns: int) -> float:
    """Of a frame that arrives a second later."""
    frame = CalibratedFrame(
        name, t_ns, Roundels.from_points(np.empty((0, 2)), 0.3), np.zeros((19, 0)), received_ns=t_ns + 10**9
    )
    admitted = clocks.admit(frame)
    assert admitted is not None
    return 1e-9 * (admitted.t_ns - t_ns)


def test_the_last_clock_that_did_not_jump_is_no_reference_for_ever():
    """All others jumped once, and it drifts later: they were corrected to follow it, and all robots with them."""
    rng, names, corrected = np.random.default_rng(2), ("cam0", "cam1", "cam2", "cam3"), np.zeros(4)
    walk, clocks = ClockWalk(4), CameraClocks(names)
    for step in range(160):
        t_ns = START_NS + step * 500_000_000
        if step in (10, 20, 30):
            walk.jump(step // 10, 1e-3, 0.0)
        offsets = np.array([5e-4 * max(0.0, 0.5 * step - 40.0), 0.0, 0.0, 0.0])
        corrected = offsets - [correction_s(clocks, name, t_ns) for name in names]
        walk.update(t_ns, *about_offsets(corrected + SIGMA_S * rng.normal(size=4)))
        for found in walk.take_departures():
            clocks.correct(found)
        clocks.hold_common(t_ns)
    assert np.abs(corrected).max() < 1e-3  # without a correction 20 ms


@pytest.mark.parametrize("ppm", [200.0, 1000.0, -5000.0])
def test_a_drift_that_begins_is_claimed_before_its_rate_is_known(ppm: float):
    """Its first departure shows an offset, which may grow as fast as it arose: with the rate claimed to 130 ppm, poses
    were 12 standard deviations off."""
    deviations, window_s = [], 0.6
    for seed in range(20):
        rng, walk, begun = np.random.default_rng(seed), ClockWalk(4), 12.0 - seed / 20
        found, drift_s, k = (), 0.0, 0
        while not found:
            drift_s = ppm * 1e-6 * window_s * max(0.0, k - begun)
            t_ns = START_NS + round(k * window_s * 1e9)
            shown = np.array([0.0, drift_s, 0.0, 0.0]) + SIGMA_S * rng.normal(size=4)
            walk.update(t_ns, *about_offsets(shown))
            found, k = walk.take_departures(), k + 1
            assert k < 40
        assert found[0].camera == 1
        error_s = found[0].at(found[0].t_ns + round(window_s * 1e9)) - drift_s - ppm * 1e-6 * window_s
        deviations.append(error_s / np.hypot(found[0].sigma_s, found[0].rate_sigma * window_s))
    assert np.mean(np.square(deviations)) < 2.3  # chi-square with 20 degrees of freedom, one in a thousand


def settled(n_cameras: int, *jumped: int) -> tuple[ClockWalk, int]:
    """Clocks that 20 windows without noise show to be right, and the time of the next one."""
    walk, window_ns = ClockWalk(n_cameras), 600_000_000
    for k in jumped:
        walk.jump(k, 1e-3, 0.0)
    for k in range(20):
        walk.update(START_NS + k * window_ns, *about_offsets(np.zeros(n_cameras)))
        walk.take_departures()
    assert not walk.departed
    return walk, START_NS + 20 * window_ns


def test_one_clock_changed_although_all_errors_together_are_within_chance():
    walk, next_ns = settled(4)
    offsets = np.array([0.0, 1.3e-3, 0.0, 0.0])
    H, y = about_offsets(offsets)
    explained = y @ np.linalg.solve(H + np.linalg.inv(walk.P[: len(y), : len(y)]), y)
    contradiction = offsets @ y[walk.offsets] - explained
    assert contradiction < chdtri(len(y), FALSE_ALARM)
    assert walk.update(next_ns, H, y)
    assert walk.departed == [1]


def test_an_offset_that_is_not_significant_is_claimed_and_not_corrected():
    walk, next_ns = settled(4, 2)
    walk.update(next_ns, *about_offsets(np.array([0.0, 0.0, 4e-4, 0.0])))
    (found,) = (d for d in walk.take_departures() if d.camera == 2)
    assert found.offset_s == 0.0
    assert found.sigma_s > 2e-4


def test_a_clock_that_departs_leaves_those_certain_that_were_corrected_before():
    """They were claimed as if each of them alone explained it, by thousands of ppm; once robots were lost, nothing
    was measured any more, and claims grew to 0.1 s."""
    walk, next_ns = settled(4, 0, 1, 2)
    walk.update(next_ns, *about_offsets(np.array([0.0, 0.0, 0.0, 0.033])))
    first, *others = walk.take_departures()
    assert (first.camera, first.offset_s) == (3, pytest.approx(0.033, rel=0.05))
    assert sorted(d.camera for d in others) == [0, 1, 2]
    assert max(d.sigma_s for d in others) < OFFSET_SIGMA_S
    assert max(d.rate_sigma for d in others) < RATE_SIGMA


@pytest.mark.parametrize("sigma", [1e-4, 2e-4])
def test_a_clock_departs_by_arrivals_where_robots_hardly_show_it(sigma: float):
    """One robot before three cameras: keyframes show offsets to 10 ms, so 2000 ppm were not seen in ten seconds."""
    found, deviations = [], []
    for seed in range(20):
        rng, walk = np.random.default_rng(seed), ClockWalk(3)
        for k in range(10):
            t_ns, offsets = START_NS + k * 10**9, np.array([0.0, -2e-3 * k, 0.0])
            for camera in range(3 if k else 0):
                walk.add_rate(t_ns, camera, (-2e-3 if camera == 1 else 0.0) + sigma * rng.normal(), sigma)
            H, y = about_offsets(offsets + 1e-2 * rng.normal(size=3))
            walk.update(t_ns, H * (SIGMA_S / 1e-2) ** 2, y * (SIGMA_S / 1e-2) ** 2)
            if departures := walk.take_departures():
                found.append((k, departures[0]))
                break
    assert [departure.camera for _, departure in found] == [1] * 20
    assert max(k for k, _ in found) < 6
    deviations = [(d.offset_s + 2e-3 * k) / d.sigma_s for k, d in found]
    assert np.mean(np.square(deviations)) < 2.3  # chi-square with 20 degrees of freedom, one in a thousand


def test_a_rate_that_may_be_of_a_delay_is_counted_and_not_believed():
    walk, now_ns = settled(4)
    for seconds in range(3):
        for camera in range(4):
            walk.add_rate(now_ns + seconds * 10**9, camera, 0.0, 1e-4)
    walk.add_rate(now_ns + 3 * 10**9, 2, 3e-3, np.inf)
    walk.predict(now_ns + 3 * 10**9)
    sigma = np.sqrt(np.diag(walk.P)[walk.rates])
    assert np.abs(walk.x).max() < 1e-12
    assert sigma[2] == pytest.approx(3e-3)
    assert np.delete(sigma, 2).max() < 2e-4


def test_corrected_stamps_have_another_rate():
    """Arrivals that wait for keyframes show the rate of the stamps as they were: it is corrected in the meantime."""
    walk, now_ns = settled(4, 2)
    walk.departed = [2]
    walk.add_rate(now_ns, 2, -1e-3, 1e-4)
    walk.update(now_ns, *about_offsets(np.zeros(4)))
    walk.add_rate(now_ns + 10**9, 2, -1e-3, 1e-4)
    (found,) = (d for d in walk.take_departures() if d.camera == 2)
    assert found.rate < -2e-4
    walk.predict(now_ns + 10**9)
    assert walk.x[walk.rates[2]] > -1e-3


def test_two_clocks_do_not_show_which_one_departs():
    assert first_departure([2e-4, 0.0], 1) is None


def test_a_jump_that_is_known_to_be_possible_is_of_that_camera():
    walk = ClockWalk(4)
    walk.jump(2, 0.02, 0.0)
    walk.update(10**9, *about_offsets(np.array([0.0, 0.0, 0.025, 0.0])))
    (found,) = walk.take_departures()
    assert found.camera == 2
    assert found.at(10**9) == pytest.approx(0.025, abs=3 * found.sigma_s)
    assert np.abs(walk.x[walk.offsets]).max() < 5e-4


def test_the_filter_is_least_squares_of_all_keyframes():
    """At one time: errors of poses and lenses do not look like offsets, though the keyframes show them together."""
    rng, n = np.random.default_rng(4), 3
    walk = ClockWalk(n)
    prior = np.linalg.inv(walk.P)[: n * ERRORS, : n * ERRORS]
    scale = np.tile(FREE_SIGMA, n)
    scale[walk.offsets] = OFFSET_SIGMA_S
    A = rng.normal(size=(3, 40, n * ERRORS)) / scale
    truth = scale * rng.normal(size=n * ERRORS)
    b = A @ truth + 0.01 * rng.normal(size=A.shape[:2])
    for rows, right in zip(A, b, strict=True):
        walk.update(10**9, rows.T @ rows, rows.T @ right)
    H = np.einsum("wki,wkj->ij", A, A) + prior
    errors = np.linalg.solve(H, np.einsum("wki,wk->i", A, b))
    np.testing.assert_allclose(walk.x[: n * ERRORS] / scale, errors / scale, atol=1e-9)
    np.testing.assert_allclose(
        walk.P[: n * ERRORS, : n * ERRORS] / np.outer(scale, scale),
        np.linalg.inv(H) / np.outer(scale, scale),
        atol=1e-9,
    )


def test_a_camera_that_moved_does_not_look_like_a_clock():
    """Images of a window depend on the pose and the clock of a camera alike; the pose changes once, by 1 mrad."""
    rng, n, start_ns, deviations = np.random.default_rng(6), 3, 10**18, []
    for _ in range(20):
        walk, moved = ClockWalk(n), np.zeros(n * ERRORS)
        for k in range(12):
            moved[:3] = 1e-3 if k >= 6 else 0.0
            A = 1e4 * rng.normal(size=(60, n * ERRORS))
            is_used = walk.update(
                start_ns + k * 600_000_000, A.T @ A, A.T @ (A @ moved + rng.normal(size=60))
            )
            assert is_used == (k != 6)
            assert not is_used or not walk.take_departures()
        deviations.append(walk.x[walk.offsets] / np.sqrt(np.diag(walk.P)[walk.offsets]))
    assert np.mean(np.square(deviations)) < 1.7  # chi-square with 60 degrees of freedom, one in a thousand


def test_what_another_offset_explains_is_the_cost_that_it_saves():
    """The cost of keyframes that show H e = y is y^T H^-1 (H^-1 + P)^-1 H^-1 y, if errors have the covariance P."""
    rng = np.random.default_rng(3)
    J, K = rng.normal(size=(2, 60, 4 * ERRORS))
    H, y, P = J.T @ J, J.T @ rng.normal(size=60), K.T @ K / 100

    def cost(P: np.ndarray) -> float:
        shown = np.linalg.solve(H, y)
        return shown @ np.linalg.solve(np.linalg.inv(H) + P, shown)

    for k, gain in enumerate(other_offsets(P, H, y)[0]):
        other = P.copy()
        other[ERRORS * k + 6, ERRORS * k + 6] += CHANGED_SIGMA[0] ** 2
        assert gain == pytest.approx(cost(P) - cost(other), rel=1e-6)
