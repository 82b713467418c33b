# SPDX-License-Identifier: BSD-3-Clause
"""Derivatives by the errors of cameras, the elimination of robots, and which hypothesis is accepted."""

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest

from fusion import _core
from fusion.rig_graph.hypotheses import (
    CAUSES,
    ERRORS,
    FREE_SHAPE_M,
    Hypothesis,
    decide,
    is_contradicted,
    retract,
    with_errors_of_stamps,
)
from tests.fusion.native.scene import ARRAY, CAMERAS, scene
from tests.fusion.rig_graph.fits import fitted

STEP = 1e-6  # rad, m and s of a central difference quotient: an error of its square, and of rounding over it


def expected_xy(errors: np.ndarray) -> np.ndarray:
    """(2, N) centres that cameras with errors (C, 8) see of the scene."""
    states, seen = scene()
    exposures = seen.detections.exposures
    T = retract(np.array([camera.matrix() for camera in CAMERAS.values()]), errors)
    at = exposures.camera
    R, centres = T[at, :3, :3].transpose(0, 2, 1), T[at, :3, 3]
    tau = exposures.tau + errors[at, 6]
    cameras = _core.CameraExposures(np.ascontiguousarray(R), centres.copy(), tau, np.zeros(len(at)))
    return _core.FramePoses(states.bodies, cameras).views(seen.discs.columns)[9:]


def derivatives(by_focal: np.ndarray | None = None) -> np.ndarray:
    """(N, 2, 8) of the centres of the scene in undistorted coordinates."""
    states, seen = scene()
    whiten = np.ascontiguousarray(np.tile(np.eye(2)[:, :, None], len(seen)))
    by_focal = np.zeros((2, len(seen))) if by_focal is None else by_focal
    poses = ARRAY.frame_poses(states, seen.detections.exposures)
    return poses.differentiate_by_camera(seen.discs.columns, whiten, by_focal)


@pytest.mark.parametrize("column", range(7))
def test_derivatives_by_camera_and_clock_are_those_of_difference_quotients(column: int):
    error = np.zeros((len(CAMERAS), ERRORS))
    error[:, column] = STEP
    quotient = (expected_xy(error) - expected_xy(-error)) / (2 * STEP)
    visible = np.isfinite(quotient[0])
    found = derivatives()[visible, :, column].T
    assert visible.sum() > 100
    np.testing.assert_allclose(found, quotient[:, visible], rtol=1e-4, atol=1e-6 * np.abs(found).max())


def test_derivatives_by_the_focal_length_are_those_given():
    given = np.random.default_rng(3).normal(size=(2, len(scene()[1])))
    found = derivatives(given)
    visible = (found[:, :, :6] != 0).any((1, 2))
    np.testing.assert_array_equal(found[visible, :, 7].T, given[:, visible])


def test_derivatives_by_the_pose_are_those_of_gtsam_for_a_point():
    states, seen = scene()
    discs = replace(seen.discs, radius=np.full(len(seen), 1e-9))
    views = ARRAY.views(states, seen.detections.exposures, discs)
    whiten = np.ascontiguousarray(np.tile(np.eye(2)[:, :, None], len(seen)))
    poses = ARRAY.frame_poses(states, seen.detections.exposures)
    found = poses.differentiate_by_camera(discs.columns, whiten, np.zeros((2, len(seen))))
    calibration, noise = gtsam.Cal3_S2(1.0, 1.0, 0.0, 0.0, 0.0), gtsam.noiseModel.Unit.Create(2)
    rows = np.flatnonzero(np.isfinite(views.xy[0]))[::10]
    for k in rows.tolist():
        camera = CAMERAS[ARRAY.names[seen.detections.camera[k]]].matrix()
        values = gtsam.Values()
        values.insert(0, gtsam.Pose3(camera))
        values.insert(1, gtsam.Point3(*(camera[:3, :3] @ views.centre[:, k] + camera[:3, 3])))
        factor = gtsam.GenericProjectionFactorCal3_S2(gtsam.Point2(0.0, 0.0), noise, 0, 1, calibration)
        jacobian, _ = factor.linearize(values).jacobian()
        np.testing.assert_allclose(found[k, :, :6], jacobian[:, :6], rtol=1e-9, atol=1e-9)


BODIES, CAMERAS_SEEING, OWNER, ROBOT = 6, 3, np.array([0, 0, 0, 2, 2]), np.array([0, 2, 0, 2, 2, 0])


def system() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """300 equations of the markers of two robots with their weights, bodies, cameras and markers."""
    rng, n = np.random.default_rng(5), 300
    body = rng.integers(0, BODIES, n)
    marker = np.where(ROBOT[body] == 0, rng.integers(0, 3, n), rng.integers(3, 5, n))
    D = rng.normal(size=(n, 2, 12 + ERRORS + 3 + 1))
    return D, rng.uniform(0.1, 1, n), body, rng.integers(0, CAMERAS_SEEING, n), marker


N_ROBOTS = 12 * BODIES + 3 * len(OWNER)  # errors of bodies and of the places of markers


def whole_system(priors: list[np.ndarray], rights: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of the errors of bodies, of places and of cameras."""
    D, weights, body, camera, marker = system()
    n, n_robots = len(D), N_ROBOTS
    A = np.zeros((n, 2, n_robots + ERRORS * CAMERAS_SEEING))
    firsts = [12 * body, n_robots + ERRORS * camera, 12 * BODIES + 3 * marker]
    for k in range(n):
        for first, columns in zip(firsts, np.split(D[k, :, :-1], [12, 12 + ERRORS], axis=1), strict=True):
            A[k, :, first[k] : first[k] + columns.shape[1]] = columns
    H, g = np.einsum("n,nai,naj->ij", weights, A, A), np.einsum("n,nai,na->i", weights, A, D[:, :, -1])
    H[range(n_robots), range(n_robots)] += np.concatenate([prior.ravel() for prior in priors])
    g[:n_robots] += np.concatenate([right.ravel() for right in rights])
    return H, g


def test_elimination_gives_the_solution_of_the_whole_system():
    D, weights, body, camera, marker = system()
    rng, n_robots = np.random.default_rng(6), N_ROBOTS
    priors = [rng.uniform(0.5, 2, (k, m)) for k, m in ((BODIES, 12), (len(OWNER), 3))]
    rights = [rng.normal(size=prior.shape) for prior in priors]
    H, g = whole_system(priors, rights)
    whole = np.linalg.solve(H, g)
    given = ROBOT, OWNER, priors[0], rights[0], priors[1], rights[1], CAMERAS_SEEING, 0.0
    reduced, *by, of_places = _core.eliminate_robots(D, weights, body, camera, marker, *given)
    step = np.linalg.solve(reduced[:, :-1], reduced[:, -1])
    np.testing.assert_allclose(step, whole[n_robots:], rtol=1e-8, atol=1e-10)
    found = [(b[:, :, -1] - b[:, :, :-1] @ step).ravel() for b in by]
    np.testing.assert_allclose(np.concatenate(found), whole[:n_robots], rtol=1e-8, atol=1e-10)
    covariance = np.linalg.inv(H[:n_robots, :n_robots])[12 * BODIES :, 12 * BODIES :]
    np.testing.assert_allclose(of_places @ covariance, np.eye(len(of_places)), atol=1e-9)


def test_a_fit_shows_the_places_of_a_robot_as_the_whole_system_does():
    """With all else unknown, and from a point of the search that is not its end."""
    D, weights, body, camera, marker = system()
    rng, none = np.random.default_rng(7), fitted(None, (), CAMERAS_SEEING, 0.0)
    places, errors = rng.normal(size=(len(OWNER), 3)), rng.normal(size=(CAMERAS_SEEING, ERRORS))
    bodies, known = np.ones((BODIES, 12)), np.full((len(OWNER), 3), FREE_SHAPE_M**-2)
    given = ROBOT, OWNER, bodies, 0 * bodies, known, -known * places, CAMERAS_SEEING, 0.0
    reduced, _, *of_places = _core.eliminate_robots(D, weights, body, camera, marker, *given)
    found = replace(none, errors=errors, places=places, reduced=reduced)
    found = replace(found, by_marker=of_places[0], of_places=of_places[1])
    H, g = whole_system([bodies, known], [0 * bodies, -known * places])
    H[N_ROBOTS:, N_ROBOTS:] += none.prior
    g[N_ROBOTS:] -= none.prior @ errors.ravel()
    covariance, step = np.linalg.inv(H), np.linalg.solve(H, g)
    for markers in (np.array([0, 1, 2]), np.array([3, 4])):
        rows = 12 * BODIES + (3 * markers[:, None] + np.arange(3)).ravel()
        of_window, y = found.equations_of_places(markers)
        with_prior = of_window + np.eye(len(y)) / FREE_SHAPE_M**2
        np.testing.assert_allclose(with_prior @ covariance[np.ix_(rows, rows)], np.eye(len(y)), atol=1e-6)
        np.testing.assert_allclose(
            np.linalg.solve(with_prior, y), places[markers].ravel() + step[rows], rtol=1e-6
        )


def test_the_less_is_known_of_the_places_of_markers_the_less_cameras_are_shown():
    """Nothing more in any direction, and as much as without errors of places where these are known."""
    D, weights, body, camera, marker = system()
    without = D.copy()
    without[:, :, 12 + ERRORS : -1] = 0.0

    def shown(equations: np.ndarray, known: float) -> np.ndarray:
        bodies, places = np.ones((BODIES, 12)), np.full((len(OWNER), 3), known)
        given = ROBOT, OWNER, bodies, 0 * bodies, places, 0 * places, CAMERAS_SEEING, 0.0
        return _core.eliminate_robots(equations, weights, body, camera, marker, *given)[0][:, :-1]

    found = [shown(D, known) for known in (1e9, 30.0, 1e-3)]
    np.testing.assert_allclose(found[0], shown(without, 1.0), atol=1e-4)
    for more, less in pairwise(found):
        assert np.linalg.eigvalsh(more - less).min() > -1e-6
        assert np.linalg.eigvalsh(more - less).max() > 1.0


@pytest.mark.parametrize(("sigmas", "contradicts"), [(0.0, False), (4.0, False), (13.0, True)])
def test_errors_far_beyond_their_prior_are_contradicted(sigmas: float, contradicts: bool):
    """A fit explains residuals by errors that the prior hardly allows: 24 degrees of freedom, one in a million."""
    none = fitted(None, (), 3, 0.0)
    errors = none.errors.copy()
    errors[1, 7] = sigmas
    assert is_contradicted(replace(none, errors=errors), np.zeros((24, 1)), 1.0) == contradicts


@pytest.mark.parametrize(("sigmas", "contradicts"), [(4.0, False), (6.0, True)])
def test_what_all_cameras_have_in_common_is_contradicted_within_chance_of_all_errors(
    sigmas: float, contradicts: bool
):
    """Each of 12 focal lengths is off by 1.2 or 1.7 of its standard deviations, all in the same direction."""
    is_focal = np.tile(np.arange(ERRORS) == 7, 12).astype(float)
    signs = np.tile(np.repeat([1.0, -1.0], ERRORS), 6)
    none, H = fitted(None, (), 12, 0.0), 100.0 * np.diag(is_focal)
    for off, shows in ((is_focal, contradicts), (is_focal * signs, False)):
        errors = sigmas / np.sqrt(12) * off
        found = errors * 100 / 101  # held back by the prior
        at = replace(none, errors=found.reshape(12, -1), reduced=np.column_stack([H, H @ (errors - found)]))
        assert is_contradicted(at, 100.0 * is_focal[:, None], 1.0) == shows


def test_the_camera_is_named_that_explains_more_than_every_other():
    fits = [fitted(None, (), 3, 2000.0), fitted("pose", (0,), 3, 900.0), fitted("pose", (1,), 3, 400.0)]
    verdict = decide(fits, range(3))
    assert (verdict.cause, verdict.cameras) == ("pose", (1,))


@pytest.mark.parametrize("n_cameras", [2, 3, 4])
def test_two_cameras_that_explain_the_same_are_both_named_and_nothing_is_decided(n_cameras: int):
    fits = [fitted(None, (), n_cameras, 2000.0)]
    fits += [fitted("pose", (k,), n_cameras, cost) for k, cost in ((0, 405.0), (1, 400.0))]
    verdict = decide(fits, range(n_cameras))
    assert (verdict.cause, verdict.cameras) == (None, (0, 1))


@pytest.mark.parametrize(("cost", "cause", "cameras"), [(410.0, None, (0, 1, 2)), (430.0, "pose", (1,))])
def test_a_camera_is_named_only_if_larger_errors_of_all_explain_less(cost: float, cause: str, cameras: tuple):
    fits = [fitted(None, (), 3, 2000.0), fitted("pose", (1,), 3, 400.0), fitted(None, (), 3, cost, 8.0)]
    verdict = decide(fits, range(3))
    assert (verdict.cause, verdict.cameras) == (cause, cameras)
    assert not verdict.is_of_rig


def test_errors_of_all_cameras_are_larger_if_no_camera_explains_them():
    fits = [fitted(None, (), 3, 2000.0), fitted("pose", (1,), 3, 1000.0), fitted(None, (), 3, 400.0, 8.0)]
    assert decide(fits, range(3)).is_of_rig


def test_half_of_the_cameras_are_never_at_fault_against_the_others():
    pair = [fitted("pose", (0, 1), 4, 400.0), fitted("pose", (2, 3), 4, 900.0)]
    verdict = decide([fitted(None, (), 4, 2000.0), *pair], range(4))
    assert (verdict.cause, verdict.cameras) == (None, (0, 1))
    assert decide([fitted(None, (), 2, 2000.0), fitted("pose", (0,), 2, 400.0)], range(2)).cause is None


def test_more_free_cameras_are_no_rival_of_one_that_explains_as_much():
    fits = [fitted(None, (), 6, 2000.0), fitted("pose", (4,), 6, 400.0), fitted("pose", (3, 4), 6, 398.0)]
    assert decide(fits, range(6)).cameras == (4,)


def test_a_camera_that_all_explanations_have_is_at_fault():
    """Whether another one moved with it is open, so its pose is not known. Before, claims of all cameras grew."""
    pairs = [fitted("pose", (2, 4), 6, 400.0), fitted("pose", (3, 4), 6, 405.0)]
    fits = [fitted(None, (), 6, 2000.0), fitted("pose", (4,), 6, 900.0), *pairs]
    verdict = decide(fits, range(6))
    assert (verdict.cause, verdict.cameras, verdict.is_pose_known) == ("pose", (4,), False)
    undecided = decide([*fits, fitted("clock", (4,), 6, 475.0)], range(6))
    assert undecided.cause is None


def test_errors_of_a_cause_are_free_and_no_others():
    for cause, columns in CAUSES.items():
        free = Hypothesis.of(cause, (1,), 3).free
        assert free[1, columns].all()
        assert free.sum() == len(range(*columns.indices(ERRORS)))


def test_errors_of_stamps_are_noise_along_image_velocities():
    """Whitened rows have the information J^T (I + s^2 u u^T)^-1 J; without motion or errors they stay."""
    rng = np.random.default_rng(5)
    rows, u, variance = rng.normal(size=(4, 2, 9)), rng.normal(size=(4, 2)), np.array([0.0, 0.3, 4.0, 1.0])
    u[3] = 0.0
    found = with_errors_of_stamps(rows.copy(), u, variance)
    for J, shown, v, s2 in zip(rows, found, u, variance, strict=True):
        assert shown.T @ shown == pytest.approx(J.T @ np.linalg.solve(np.eye(2) + s2 * np.outer(v, v), J))
