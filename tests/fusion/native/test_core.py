# SPDX-License-Identifier: BSD-3-Clause
"""The native core compared with the same equations in NumPy (`tests/fusion/equations.py`).

Only the rounding differs, by about 1e-15 of the largest term; 1e-9 allows for cancellation.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.pose import rotation_from_vector
from fusion import _core
from fusion.model.states import States, predict
from tests.fusion import equations
from tests.fusion.native.scene import ARRAY, BODIES, scene

assert_near = partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-9)


def test_views_equal_the_observation_model():
    states, seen = scene()
    exposures = seen.detections.exposures
    found = ARRAY.views(states, exposures, seen.discs)
    expected = equations.view(equations.pose(ARRAY, states, exposures), seen.discs)
    assert np.isnan(expected.xy).any()
    for name in ("centre", "normal", "q", "xy", "facing"):
        assert_near(getattr(found, name), getattr(expected, name))


def test_equations_of_centres_equal_the_derivatives():
    states, seen = scene()
    exposures, discs = seen.detections.exposures, seen.discs
    single = np.arange(BODIES) == 1
    of_centre = seen.detections.xy, seen.whiten, single
    found = ARRAY.frame_poses(states, exposures).linearize_centres(discs.columns, *of_centre)
    poses = equations.pose(ARRAY, states, exposures)
    views = equations.view(poses, discs)
    A = equations.derive(ARRAY, poses, exposures, discs, views, seen.whiten)
    A[:, 6:9, single[discs.body]] = 0
    b = np.einsum("ain,in->an", seen.whiten, seen.detections.xy - views.xy)
    rows = np.concatenate([A, b[:, None]], 1).transpose(2, 0, 1)
    rows[np.isnan(b[0])] = 0
    assert_near(found, rows, atol=1e-9 * np.abs(rows).max())


def test_equations_of_outlines_equal_difference_quotients():
    """The shape of an outline is a difference of numbers that are larger by (range / radius)^2, up to 4e4. Divided by
    the step of 1e-4 and sigma, rounding of 2e-16 becomes 1e-6, of derivatives of about 30."""
    states, seen = scene()
    exposures, discs = seen.detections.exposures, seen.discs
    sigma = np.linspace(0.1, 0.2, len(discs))
    of_outline = seen.detections.axes_px, seen.detections.angle_rad, seen.detections.scale, sigma
    found = ARRAY.frame_poses(states, exposures).linearize_outlines(discs.columns, *of_outline)
    poses = equations.pose(ARRAY, states, exposures)
    views = equations.view(poses, discs)
    rows = equations.shape_rows(poses, discs, views, seen, sigma)
    rows[np.isnan(views.xy[0])] = 0
    assert_near(found, rows, atol=1e-6)


def test_rows_of_a_rolling_shutter_are_frames_of_their_own():
    """Discs that are captured some time after their frames have the views and equations of frames at that time."""
    states, seen = scene()
    exposures, n = seen.detections.exposures, len(seen)
    delay = np.random.default_rng(4).uniform(-0.02, 0.02, n)
    rows = replace(exposures, **{k: getattr(exposures, k)[seen.discs.frame] for k in exposures.__slots__})
    rows = replace(rows, tau=rows.tau + delay)
    discs = replace(seen.discs, delay=delay), replace(seen.discs, frame=np.arange(n), delay=None)
    poses = ARRAY.frame_poses(states, exposures), ARRAY.frame_poses(states, rows)
    given = seen.detections.xy, seen.whiten, np.zeros(BODIES, bool)
    outlines = seen.detections.axes_px, seen.detections.angle_rad, seen.detections.scale, np.full(n, 0.1)
    for call in (
        lambda p, d: p.views(d.columns),
        lambda p, d: p.linearize_centres(d.columns, *given),
        lambda p, d: p.linearize_outlines(d.columns, *outlines),
    ):
        assert_near(call(poses[0], discs[0]), call(poses[1], discs[1]))


def test_a_fit_is_reweighted_least_squares_of_the_bodies_that_still_move():
    random = np.random.default_rng(8)
    states, seen = scene()
    discs, exposures, n = seen.discs, seen.detections.exposures, len(seen)
    xy = np.nan_to_num(ARRAY.views(states, exposures, discs).xy) + 2e-3 * random.normal(size=(2, n))
    xy[:, :9] += 0.1  # outliers
    whiten, sigma, single = np.tile(500 * np.eye(2)[..., None], n), np.full(n, 0.2), np.zeros(BODIES, bool)
    xy[:, -1], whiten[..., -1], cov = np.nan, np.nan, np.tile(4 * np.eye(2)[..., None], n)
    shaped, turned = random.random((2, n)) < [[0.5], [0.1]]
    shape = seen.detections.axes_px, seen.detections.angle_rad, seen.detections.scale, sigma
    prior, headings = np.tile(3 * np.eye(12), (BODIES, 1, 1)), random.normal(size=(turned.sum(), 2, 13))
    frames = ARRAY.exposed(exposures)
    predicted = ARRAY.frame_poses(states, exposures).linearize_centres(discs.columns, xy, whiten, single)
    fit = _core.BodyFit(
        states.bodies, frames, discs.columns, xy, whiten, single, *shape, shaped, turned, predicted, prior
    )
    owner = np.concatenate([discs.body, discs.body[shaped], discs.body[turned]])
    delta, moving, weights = np.zeros((BODIES, 12)), np.unique(owner), np.ones(len(owner))
    steps, rest = 0.02 * random.normal(size=(BODIES, 12)), np.zeros((n, 2))
    steps[2, :6] = 0.01
    for step in (steps, steps[np.arange(BODIES) != 2]):
        poses = ARRAY.frame_poses(states.retract(delta), exposures)
        centres = poses.linearize_centres(discs.columns, xy, whiten, single)
        outlines = poses.linearize_outlines(discs.columns, *shape)[shaped]
        rows, right = np.concatenate([centres, outlines, headings]), -(prior @ delta[..., None])[..., 0]
        H, g, updated = equations.reweigh(rows, owner, prior, right, weights)
        mine = np.isin(owner, moving)
        weights = np.where(mine, updated, weights)
        for found, expected in zip(fit.linearize(headings), (H[moving], g[moving]), strict=True):
            assert_near(found, expected, atol=1e-9 * np.abs(expected).max())
        assert fit.step(step, 0.011)
        delta[moving] += step
        errors = centres[:, :, 12] - np.einsum("nai,ni->na", centres[:, :, :12], steps[discs.body])
        rest[mine[:n]] = errors[mine[:n]]
        R, (p, omega, v), P, _, used, squared, costs = fit.result(states.P, cov)
        assert_near(used, weights[:n])
        lengths = np.append(4 * (rest[:-1] ** 2).sum(1), np.nan)
        assert_near(squared, lengths, atol=1e-9 * np.nanmax(lengths))
        estimates = States(R, p, omega, v, states.P)
        assert_near(estimates.minus(states.retract(delta)), np.zeros((BODIES, 12)))
        moving = moving[moving != 2]
    assert_near(P[moving], np.linalg.inv(H)[moving])
    observed = 16 * np.log1p(np.where(squared < 400, squared / 4, 100) / 16)
    moved = np.einsum("bi,bij,bj->b", delta, prior, delta)
    assert_near(costs, np.bincount(discs.body, observed, BODIES) + moved)


def test_whitened_errors_are_distances_in_pixels():
    random = np.random.default_rng(3)
    root, scale, pixels = random.normal(size=(5, 2, 3)), random.normal(size=(5, 2, 2)), np.ones((5, 2))
    cov = root @ root.transpose(0, 2, 1)
    inverse = np.linalg.inv(np.linalg.cholesky(cov))
    columns = np.ascontiguousarray(cov.transpose(1, 2, 0)), np.ascontiguousarray(scale.transpose(1, 2, 0))
    whiten = np.ascontiguousarray((inverse @ scale).transpose(1, 2, 0))
    assert_near(_core.whiten(*columns), whiten)
    whiten[..., 4] = np.nan
    errors = (inverse @ pixels[..., None])[..., 0]
    found = _core.squared_px(errors, np.ascontiguousarray(cov.transpose(1, 2, 0)), whiten)
    assert_near(found[:4], 2 * np.ones(4))
    assert np.isnan(found[4])


@pytest.mark.parametrize("added_px2", [0.0, 0.7])
def test_assignments_are_own_that_are_more_probable_than_other_roundels(added_px2: float):
    """Compared with the innovations of all, and of the certain ones alone, by their covariances in pixels; a prior just
    above and just below the likelihood ratio decides."""
    random = np.random.default_rng(9)
    n, of_body, of_camera = 60, np.array([0, 1, 2, 2]), np.array([-1, 0, 1, 2])
    J, nu_px, log_density = random.normal(size=(n, 2, 12)), random.normal(size=(n, 2)), random.normal(size=n)
    (body, camera), certain = random.integers(0, 3, (2, n)), random.random(n) < 0.5
    root, noise = random.normal(size=(3, 12, 20)), random.normal(size=(n, 2, 4))
    P, cov = root @ root.transpose(0, 2, 1), noise @ noise.transpose(0, 2, 1)
    whiten = np.linalg.inv(np.linalg.cholesky(cov))
    whitened = whiten @ np.concatenate([J, nu_px[..., None]], axis=2)
    evidence = whitened, np.moveaxis(cov, 0, 2).copy(), log_density

    def judged(of_body: Index, of_camera: Index, turn: Index, prior: Array) -> Mask:
        doubts = of_body, of_camera, turn, prior, np.full(len(prior), added_px2)
        return _core.are_own(*evidence, body, camera, certain, _core.inverses(P), *doubts)

    def ratio(b: int, c: int, certain: Mask) -> tuple[float, Mask]:
        beside, new = ((body == b) & mask for mask in (certain, ~certain & ((c < 0) | (camera == c))))
        likelihoods = []
        for rows in (np.flatnonzero(beside | new), np.flatnonzero(beside)):
            A, of_noise = J[rows].reshape(-1, 12), np.zeros((2 * len(rows), 2 * len(rows)))
            for i, k in enumerate(rows):
                of_noise[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = cov[k] + added_px2 * np.eye(2)
            S, e = A @ P[b] @ A.T + of_noise, nu_px[rows].ravel()
            likelihoods.append(-0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(2 * np.pi * S)[1]))
        return likelihoods[0] - likelihoods[1] - log_density[new].sum(), new

    expected = [ratio(b, c, certain) for b, c in zip(of_body, of_camera, strict=True)]
    prior = np.array([1e-6 - value for value, _ in expected])
    together = np.zeros(4, np.intp)
    assert (judged(of_body, of_camera, together, prior - 2e-6) == certain).all()
    accepted = certain | np.any([new for _, new in expected], axis=0)
    assert (judged(of_body, of_camera, together, prior) == accepted).all()
    # In turns, the last view is judged given the one before.
    later, new = ratio(2, 2, certain | expected[2][1])
    for aside, also in ((1e-6, new), (-1e-6, np.zeros(n, bool))):
        turns = judged(of_body[2:], of_camera[2:], np.arange(2), np.array([prior[2], aside - later]))
        assert (turns == (certain | expected[2][1] | also)).all()
    with pytest.raises(IndexError):
        judged(of_body + 1, of_camera, together, prior)


def test_prediction_equals_the_motion_model():
    random = np.random.default_rng(6)
    states, _ = scene()
    root = random.normal(size=(BODIES, 12, 20))
    states = replace(states, P=root @ root.transpose(0, 2, 1))
    of_each = random.uniform(1e-3, 0.2, BODIES), random.uniform(0.1, 9, (BODIES, 2)), np.arange(BODIES) == 2
    (found, motion), (expected, of_errors) = predict(states, *of_each), equations.predict(states, *of_each)
    assert_near(motion.T, of_errors.T)
    for name in States.__slots__:
        assert_near(getattr(found, name), getattr(expected, name))


@pytest.mark.parametrize("seed", range(20))
def test_assignment_chooses_the_most_pairs_at_the_lowest_cost(seed: int):
    """Compared with SciPy on whole frames, from a few pairs to every marker near every detection."""
    random = np.random.default_rng(seed)
    frame = np.repeat(np.arange(3), random.integers(1, 30, 3))
    marker, detection = np.nonzero(random.random((25, len(frame))) < random.uniform(0.02, 1))
    order = np.argsort(frame[detection], kind="stable")
    pairs, costs = np.stack([marker, detection])[:, order], random.normal(size=len(order))
    chosen = _core.assign(pairs, costs, frame)
    expected = 0
    for f in range(3):
        dense = np.full((25, len(frame)), 1e4)
        of_frame = frame[pairs[1]] == f
        dense[pairs[0, of_frame], pairs[1, of_frame]] = costs[of_frame]
        best = dense[linear_sum_assignment(dense)]
        expected += best[best < 1e4].sum()
        assert (frame[pairs[1, chosen]] == f).sum() == (best < 1e4).sum()
    assert len(set(pairs[1, chosen].tolist())) == len(chosen)
    assert len({(f, m) for f, m in zip(frame[pairs[1, chosen]], pairs[0, chosen], strict=True)}) == len(
        chosen
    )
    assert costs[chosen].sum() == pytest.approx(expected, abs=1e-9)


def test_inverses_are_inverse_matrices():
    root = np.random.default_rng(9).normal(size=(3, 12, 20))
    information = root @ root.transpose(0, 2, 1)
    assert_near(_core.inverses(information), np.linalg.inv(information))
    information[1] -= 50 * np.eye(12)
    with pytest.raises(RuntimeError, match="not positive definite"):
        _core.inverses(information)


@pytest.mark.parametrize("spread", [pytest.param(1.0, marks=pytest.mark.ci), 2.0])
def test_candidates_are_the_pairs_within_the_gates(spread):
    """Discs a few pixels from detections: some pairs are too far apart, and some sizes do not fit.

    With a larger spread, bodies are beside what cameras see, where the core leaves out whole bodies.
    """
    states, seen = scene()
    states = replace(states, p=spread * states.p)
    exposures, discs = seen.detections.exposures, seen.discs
    random = np.random.default_rng(3)
    exposures = replace(
        exposures, clock_sigma=random.uniform(0, 0.05, len(exposures.tau))
    )  # 100 px/s: up to 5 px
    seen = replace(seen, detections=replace(seen.detections, exposures=exposures))
    states = replace(states, P=np.tile(1e-3 * np.eye(12), (BODIES, 1, 1)), v=0.01 * states.v)
    rows = random.choice(len(discs), 100, replace=False)
    rows = rows[np.argsort(discs.body[rows], kind="stable")]  # in groups
    of = discs.select(rows)
    expected = _core.ExpectedMarkers(states.R, states.P, of.body, of.body, of.position, of.normal, of.radius)
    poses = ARRAY.frame_poses(states, exposures)
    (marker, sighting), cost = expected.candidates(
        poses, seen.detections.native, ARRAY.focal[exposures.camera]
    )
    found = {}
    for f, tau in enumerate(exposures.tau):
        there = discs.select(rows)
        there = replace(there, frame=np.full(len(rows), f))
        found |= {
            (f, *pair): value
            for pair, value in equations.candidates(
                ARRAY, states, seen.detections, there, expected.covariances(tau)
            ).items()
        }
    got = dict(
        zip(
            zip(seen.detections.frame[sighting].tolist(), marker.tolist(), sighting.tolist(), strict=True),
            cost,
            strict=True,
        )
    )
    assert got.keys() == found.keys()
    assert len(got) > 20
    assert_near([got[key] for key in found], list(found.values()))


def test_indices_and_lengths_are_checked():
    """The core refuses an array that does not fit and never reads beyond its end."""
    states, seen = scene()
    poses = ARRAY.frame_poses(states, seen.detections.exposures)
    frame, body = seen.discs.frame, seen.discs.body
    position, normal, radius = seen.discs.position, seen.discs.normal, seen.discs.radius
    for wrong in (body + BODIES, body - BODIES):
        with pytest.raises(IndexError):
            poses.views(_core.DiscColumns(frame, wrong, position, normal, radius, 0 * radius))
    with pytest.raises(ValueError, match="lengths"):
        _core.DiscColumns(frame, body, position[:, 1:].copy(), normal, radius, 0 * radius)


def test_a_disc_seen_edge_on_gives_finite_equations_or_zeros():
    """Its outline is a line. Within one step of the derivative (1e-4 rad) of it there is no outline to compare with."""
    tilt = np.radians(90) + np.linspace(-3e-4, 3e-4, 61)
    n, none = len(tilt), np.zeros(len(tilt), np.intp)
    up = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])  # towards the camera
    R = rotation_from_vector(np.outer(tilt, [1.0, 0.0, 0.0])) @ up
    still = np.zeros((n, 3))
    ahead, camera = np.tile([0.0, 0.0, 2.0], (n, 1)), np.eye(3)[None].copy()
    exposures = _core.CameraExposures(camera, np.zeros((1, 3)), np.zeros(1), np.zeros(1))
    poses = _core.FramePoses(_core.BodyStates(R, ahead, still, still), exposures)
    up = np.tile([[0.0], [0.0], [1.0]], n)
    discs = _core.DiscColumns(none, np.arange(n), np.zeros((3, n)), up, np.full(n, 0.04), np.zeros(n))
    scale = np.tile(800 * np.eye(2)[..., None], n)
    axes = np.tile([[30.0], [10.0]], n)
    rows = poses.linearize_outlines(discs, axes, np.zeros(n), scale, np.full(n, 0.1))
    assert np.isfinite(rows).all()
    assert not rows[n // 2].any()
