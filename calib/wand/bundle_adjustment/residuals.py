# SPDX-License-Identifier: BSD-3-Clause
"""The residuals of the wand's bundle adjustment, what whitens them, and their derivatives.

Residuals are the reprojection errors of marker centres at their own capture times, deviations of the motion from
constant velocity, of the wand from its lengths, and of cameras and the wand's shape from their priors. `linearize`
differentiates all of them in one NumPy batch: every observation depends on one camera, on the shape, and on the two
knots around its time. The observations of one camera between two knots are a `view`: rows of derivatives by the camera,
the knot, the next knot and the shape.

Background points are eliminated, so that they constrain the cameras only. Their positions are optimal for the cameras
of every state (variable projection: Golub and Pereyra 1973), and the Schur complement of each point leaves the cameras
alone. docs/design/wand_adjustment.md has the equations.
"""

from dataclasses import dataclass, replace

import numpy as np

from calib.rig.camera import LENS, NEAREST_M, PER_CAMERA, POSE, pixel_jacobians
from calib.rig.estimation import CAUCHY_SCALE, STEPS, cauchy_cost, cauchy_weights, coordinate_sigma
from calib.rig.triangulation import intersect_images
from calib.wand.bundle_adjustment.problem import (
    AffineWand,
    BackgroundPoints,
    Problem,
    State,
    WandObservations,
)
from calib.wand.trajectory import (
    SplineLocation,
    locate,
    position_weights,
    velocity_weights,
    whitened_constant_velocity,
)
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.lens import Lens

LENGTH_SIGMA_M = 2e-4  # by which a wand bends while it moves
SPEED_SIGMA = 3.0  # metres per second of a hand
SCALE_SIGMA = 1e-6  # relative, of a distance that fixes the scale
STEP_SIGMA_M = 0.5  # of a position's change in one step: damps positions that too few cameras observe
BEHIND = 1e4  # sigmas: the residual of a point behind its camera
POINT_STEPS = 3  # of Gauss-Newton: a point moves little while its cameras take one step
# Relative information that is added to every coordinate: a point on parallel rays stays where it is.
REGULAR = 1e-9


@dataclass(frozen=True, slots=True)
class Weights:
    """Whitening matrices of the residuals, and robust weights.

    Attributes:
        pixel: (n, 2, 2) whitening matrices of the reprojection errors.
        motion: (L, 2, 4) whitened deviations from constant velocity, as factors of p0, v0, p1, v1, of each interval
            between knots; zero across gaps.
        observation, interval: (n,) and (L,) robust weights of either.
        background: which images of background points are used.
    """

    pixel: Array
    motion: Array
    observation: Array
    interval: Array
    background: Mask

    def select(self, choice: "Choice") -> "Weights":
        """The weights of what was chosen."""
        motion = self.motion.copy()
        motion[choice.interrupted] = 0.0
        rows = choice.observations
        return Weights(self.pixel[rows], motion, self.observation[rows], self.interval, choice.background)


@dataclass(frozen=True, slots=True)
class Choice:
    """Which of the n `observations` and of the images of `background` points are used, and in which of the L intervals
    between knots the motion prior is `interrupted`."""

    observations: Mask
    interrupted: Mask
    background: Mask

    def equals(self, other: "Choice") -> bool:
        """Whether both choices are the same."""
        return all(np.array_equal(getattr(self, name), getattr(other, name)) for name in self.__slots__)


def find_weights(problem: Problem, observations: WandObservations, state: State) -> Weights:
    """Whitening matrices at a state; robust weights are 1.

    The covariance of a reprojection error is the detector's, plus that of the position between two knots, plus that of
    the stamp along the marker's image motion.
    """
    motion = predict_markers(problem, observations, state)
    spread = problem.density * motion.location.spread
    lenses = state.corrected(problem.lenses)
    J = _known(point_jacobians(lenses, state.cameras, observations.camera, motion.points)[1])
    along = observations.stamp_sigma_s[:, None] * motion.velocity(problem.knot_s)
    by_stamp = J @ along[:, :, None]
    cov = observations.cov + spread[:, None, None] * J @ np.swapaxes(J, 1, 2)
    cov += by_stamp @ np.swapaxes(by_stamp, 1, 2)
    pixel = np.asarray(np.linalg.inv(np.linalg.cholesky(cov)), float)
    dt = np.diff(problem.knot_s)
    smooth, near = np.zeros((len(dt), 2, 4)), (dt <= problem.gap_s) & (dt > 0)
    smooth[near] = whitened_constant_velocity(dt[near], problem.density)
    every = np.ones(len(problem.background.uv), bool)
    return Weights(pixel, smooth, np.ones(len(observations)), np.ones(len(dt)), every)


@dataclass(frozen=True, slots=True)
class MarkerMotion:
    """Observed markers on the trajectory.

    Attributes:
        t_s: (n,) true capture times.
        location: of these among the knots.
        hermite: (n, 4) weights of p0, v0, p1, v1 in the position.
        ends: (n, 4, 3) the marker's p0, v0, p1, v1, world.
        wand: of the state's shape.
    """

    t_s: Array
    location: SplineLocation
    hermite: Array
    ends: Array
    wand: AffineWand

    @property
    def points(self) -> Array:
        """(n, 3) positions, world."""
        return (self.hermite[:, None] @ self.ends)[:, 0]

    def velocity(self, knot_s: Array) -> Array:
        """(n, 3) velocities, world."""
        return (velocity_weights(knot_s, self.t_s, self.location)[:, None] @ self.ends)[:, 0]


def predict_markers(problem: Problem, observations: WandObservations, state: State) -> MarkerMotion:
    """Evaluate the trajectory for every observation, at its true capture time."""
    knot_s, motion = problem.knot_s, state.motion
    t_s = state.true_times(observations, problem.middle_s)
    location = locate(knot_s, t_s, problem.gap_s)
    ends = np.concatenate([motion[location.interval], motion[location.interval + 1]], axis=1)
    wand = problem.wand.displaced(state.shape)
    marker = (wand.weights[observations.label][:, None, None] @ ends)[:, :, 0]
    return MarkerMotion(t_s, location, position_weights(knot_s, t_s, location), marker, wand)


def reprojection_errors(problem: Problem, observations: WandObservations, state: State) -> Array:
    """(n, 2) observed minus predicted pixels; NaN behind the camera."""
    points = predict_markers(problem, observations, state).points
    errors = np.empty((len(observations), 2))
    for c, lens in enumerate(problem.lenses):
        rows, T = observations.camera == c, state.cameras[c]
        local = (points[rows] - T[:3, 3]) @ T[:3, :3]
        uv = state.lens(c, lens).project(local)
        errors[rows] = np.where(local[:, 2:] > NEAREST_M, observations.uv[rows] - uv, np.nan)
    return errors


def whitened_errors(
    problem: Problem, observations: WandObservations, state: State, weights: Weights
) -> Array:
    """(n, 2) reprojection errors in standard deviations; 1e4 behind the camera."""
    errors = reprojection_errors(problem, observations, state)
    return np.nan_to_num((weights.pixel @ errors[:, :, None])[:, :, 0], nan=BEHIND)


def point_jacobians(lenses: list[Lens], cameras: Array, camera: Index, points: Array) -> tuple[Array, Array]:
    """Transform points to their cameras' frames, and differentiate their pixels.

    Args:
        lenses, cameras: of C cameras, (C, 4, 4) T_world_cam.
        camera: (n,) the camera of each point.
        points: (n, 3) world.

    Returns:
        local: (n, 3) camera frames.
        J: (n, 2, 3) derivatives of the pixels by the points in the world; NaN behind the camera.
    """
    local, J = np.empty((len(points), 3)), np.empty((len(points), 2, 3))
    for c, lens in enumerate(lenses):
        rows, T = np.flatnonzero(camera == c), cameras[c]
        local[rows] = (points[rows] - T[:3, 3]) @ T[:3, :3]
        J[rows] = lens.project_with_jacobian(local[rows])[1] @ T[:3, :3].T
    return local, J


def motion_errors(problem: Problem, state: State, weights: Weights) -> tuple[Array, Array, Array]:
    """Whitened deviations from constant velocity (L, 2, B, 3), wand lengths (K, E) and zero speed (K, B, 3)."""
    wand, motion = problem.wand.displaced(state.shape), state.motion
    pairs = np.concatenate([motion[:-1], motion[1:]], axis=1)
    ends = motion[:, 0][:, wand.pairs]
    lengths = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2)
    smooth = np.einsum("lij,ljbx->libx", weights.motion, pairs)
    return smooth, (lengths - wand.lengths) / LENGTH_SIGMA_M, motion[:, 1] / SPEED_SIGMA


def global_priors(problem: Problem, state: State) -> tuple[Array, Array, float]:
    """The priors of all cameras' free parameters, of the wand's shape, and of the distance that fixes the scale, at a
    state.

    Returns:
        their information (C d + n, C d + n), their gradient (C d + n,), and the sum of their squared errors in sigmas.
    """
    free, poses, n = list(problem.free), np.zeros((len(state.cameras), len(POSE))), problem.shapes
    of_cameras = np.column_stack([poses, state.clocks, state.lenses])[:, free]
    values = np.append(of_cameras, state.shape[:n])
    sigma = np.append(problem.prior_sigma(), np.full(n, problem.shape_sigma()))
    information, gradient = np.diag(sigma**-2), -values / sigma**2
    squares = float(((values / sigma) ** 2).sum())
    if problem.fixed_distance:
        a, b, distance = problem.fixed_distance
        gap = state.cameras[a, :3, 3] - state.cameras[b, :3, 3]
        along = gap / np.linalg.norm(gap) / distance / SCALE_SIGMA
        by_pose = np.zeros(of_cameras.shape)
        by_pose[a, 3:6], by_pose[b, 3:6] = along @ state.cameras[a, :3, :3], -along @ state.cameras[b, :3, :3]
        J = np.append(by_pose, np.zeros(n))
        error = (1 - float(np.linalg.norm(gap)) / distance) / SCALE_SIGMA
        information += np.outer(J, J)
        gradient += J * error
        squares += error**2
    return information, gradient, squares


@dataclass(frozen=True, slots=True)
class ErrorNorms:
    """Whitened residuals of a state, in sigmas.

    Attributes:
        observation: (n,) norms of the reprojection errors.
        interval: (L,) root mean square of the `size` deviations from constant velocity in each interval.
        rest: sum of squares of all other residuals.
    """

    observation: Array
    interval: Array
    size: int
    rest: float

    def cost(self, observation_scale: float = np.inf, interval_scale: float = np.inf) -> float:
        """Half the sum of squares, under Cauchy's kernel at these scales; plain squares where a scale is infinite."""
        smooth = self.size * cauchy_cost(self.interval**2, interval_scale)
        return 0.5 * float(cauchy_cost(self.observation**2, observation_scale) + smooth + self.rest)

    def reweight(self, weights: Weights, observation_scale: float, interval_scale: float) -> Weights:
        """The weights with robust ones of Cauchy's kernel at these scales."""
        observation = cauchy_weights(self.observation, observation_scale)
        return replace(
            weights, observation=observation, interval=cauchy_weights(self.interval, interval_scale)
        )


def error_norms(
    problem: Problem, observations: WandObservations, state: State, weights: Weights
) -> ErrorNorms:
    """Evaluate all residuals at a state."""
    smooth, lengths, speed = motion_errors(problem, state, weights)
    size = 6 * len(problem.wand.basis)
    interval = np.sqrt((smooth**2).sum(axis=(1, 2, 3)) / size)
    beside = point_error_norms(problem, state)[weights.background]
    rest = sum((term**2).sum() for term in (lengths, speed, beside)) + global_priors(problem, state)[2]
    pixel = whitened_errors(problem, observations, state, weights)
    return ErrorNorms(np.linalg.norm(pixel, axis=1), interval, size, float(rest))


@dataclass(frozen=True, slots=True)
class LinearSystem:
    """The linear least-squares system for a step from a state.

    Attributes:
        problem: that was linearized.
        views: (V,) interval between knots times C plus camera, ascending.
        rows: (2n, m) sorted by view: whitened derivatives by the camera's free parameters (d), the first knot and the
            next one (12 B) and the wand's shape (n), and the whitened residual.
        bounds: (V + 1,) the first row of each view, and the number of rows.
        chain: (L, 12 B + n + 1, 12 B + n + 1) augmented Hessians of the motion terms by both knots and the shape, of
            each interval: knot k's own terms are in interval k, the last knot's in the last interval.
        motion_prior: (L, 12 B + n + 1, 12 B + n + 1) the part of `chain` from the prior of the motion: constant
            velocity and zero speed.
        priors: information (C d + n, C d + n) and gradient (C d + n,) of the priors of all cameras and of the shape.
        by_points, point_scores: (C, d, C, d) information of all background points on the cameras, and (J, C, d)
            gradients by point, the points eliminated.
    """

    problem: Problem
    views: Index
    rows: Array
    bounds: Index
    chain: Array
    motion_prior: Array
    priors: tuple[Array, Array]
    by_points: Array
    point_scores: Array


def linearize(
    problem: Problem, observations: WandObservations, state: State, weights: Weights
) -> LinearSystem:
    """Linearize all residuals around a state."""
    motion = predict_markers(problem, observations, state)
    error, J_camera, J_point = reprojection_jacobians(problem, observations, state, motion)
    root = np.sqrt(weights.observation)[:, None, None] * weights.pixel
    of_basis = motion.wand.weights[observations.label]
    by_basis = (motion.hermite[:, :, None] * of_basis[:, None]).reshape(len(error), 1, -1, 1)
    J_point = root @ J_point
    J_knots = (by_basis * J_point[:, :, None]).reshape(len(error), 2, -1)
    J_shape = _by_shape(problem, observations, state, motion, J_point)
    rows = np.concatenate([root @ J_camera, J_knots, J_shape, root @ error[:, :, None]], axis=2)
    view = motion.location.interval * len(problem.lenses) + observations.camera
    order = np.argsort(view, kind="stable")
    first = np.flatnonzero(np.diff(view[order], prepend=-1))
    motion_prior = _linearize_prior(problem, state, weights)
    by_points, point_scores = eliminate_points(problem, state, weights.background)
    return LinearSystem(
        problem,
        views=view[order][first],
        rows=rows[order].reshape(-1, rows.shape[2]),
        bounds=2 * np.append(first, len(view)),
        chain=motion_prior + _linearize_lengths(problem, state),
        motion_prior=motion_prior,
        priors=global_priors(problem, state)[:2],
        by_points=by_points,
        point_scores=point_scores,
    )


def reprojection_jacobians(
    problem: Problem, observations: WandObservations, state: State, motion: MarkerMotion
) -> tuple[Array, Array, Array]:
    """Reprojection errors (n, 2), 0 behind the camera, and the derivatives of the predicted pixels by the camera's
    free parameters (n, 2, d) and by the marker's position in the world (n, 2, 3)."""
    points, velocity = motion.points, motion.velocity(problem.knot_s)
    since = observations.t_s - problem.middle_s
    error, J_point = np.zeros((len(observations), 2)), np.zeros((len(observations), 2, 3))
    J_camera = np.zeros((len(observations), 2, PER_CAMERA))
    for c, given in enumerate(problem.lenses):
        rows, T, lens = np.flatnonzero(observations.camera == c), state.cameras[c], state.lens(c, given)
        local = (points[rows] - T[:3, 3]) @ T[:3, :3]
        uv, *parts = pixel_jacobians(lens, local)
        J, J_pose, J_lens = (_known(part) for part in parts)
        error[rows] = _known(observations.uv[rows] - uv)
        J_point[rows] = J @ T[:3, :3].T
        J_camera[rows, :, :6], J_camera[rows, :, LENS[0] :] = J_pose, J_lens
    J_camera[:, :, 6] = (J_point @ velocity[:, :, None])[:, :, 0]
    J_camera[:, :, 7] = J_camera[:, :, 6] * since[:, None]
    J_camera[:, :, 8] = J_camera[:, :, 6] * observations.image_row[:, None]
    return error, J_camera[:, :, list(problem.free)], J_point


def _by_shape(
    problem: Problem, observations: WandObservations, state: State, motion: MarkerMotion, J_point: Array
) -> Array:
    """(n, 2, shapes) derivatives of the predicted pixels by the wand's shape, from those by the marker's position."""
    if not problem.shapes:
        return np.zeros((len(observations), 2, 0))
    first = motion.location.interval
    ends = np.concatenate([state.motion[first], state.motion[first + 1]], axis=1)
    basis = np.einsum("ni,nibx->nbx", motion.hermite, ends)
    by_weights = motion.wand.jacobians()[0][:, observations.label]
    return np.asarray(np.einsum("npx,snb,nbx->nps", J_point, by_weights, basis, optimize=True), float)


def _linearize_prior(problem: Problem, state: State, weights: Weights) -> Array:
    """`LinearSystem.motion_prior`: constant velocity between knots, and zero speed at each."""
    B, K, n = len(problem.wand.basis), len(state.motion), problem.shapes
    local = 12 * B
    smooth, _, speed = motion_errors(problem, state, weights)
    weighted = weights.interval[:, None, None] * weights.motion
    H = np.einsum("lri,lrj->lij", weighted, weights.motion)
    of_speed, g = np.repeat([0.0, SPEED_SIGMA**-2, 0.0], [3 * B, 3 * B, n]), np.zeros((K, 6 * B + n))
    g[:, 3 * B : 6 * B] = -speed.reshape(K, -1) / SPEED_SIGMA
    chain = _sum_knots(np.broadcast_to(np.diag(of_speed), (K, 6 * B + n, 6 * B + n)), g, 6 * B)
    chain[:, :local, :local] += np.kron(H, np.eye(3 * B)[None])
    chain[:, :local, -1] -= np.einsum("lri,lrbx->libx", weighted, smooth).reshape(K - 1, local)
    return chain


def _linearize_lengths(problem: Problem, state: State) -> Array:
    """The part of `LinearSystem.chain` from the wand's lengths, and the damping."""
    wand, K = problem.wand.displaced(state.shape), len(state.motion)
    B, E, n = len(wand.basis), len(wand.pairs), problem.shapes
    gap = state.motion[:, 0][:, wand.pairs]
    gap = gap[:, :, 0] - gap[:, :, 1]
    length = np.linalg.norm(gap, axis=2)
    by_knot = np.zeros((K, E, 2, B, 3))
    for e, (i, j) in enumerate(wand.pairs):
        along = gap[:, e] / length[:, e, None]
        by_knot[:, e, 0, i], by_knot[:, e, 0, j] = along, -along
    by_shape = np.broadcast_to(-wand.jacobians()[1][:n].T, (K, E, n))
    J = np.concatenate([by_knot.reshape(K, E, 6 * B), by_shape], axis=2) / LENGTH_SIGMA_M
    error = (wand.lengths - length) / LENGTH_SIGMA_M
    H = J.mT @ J + np.diag(np.append(np.repeat([STEP_SIGMA_M**-2, 0.0], 3 * B), np.zeros(n)))
    return _sum_knots(H, np.einsum("kri,kr->ki", J, error), 6 * B)


def _sum_knots(H: Array, g: Array, h: int) -> Array:
    """Hessians (K, h + n, h + n) and gradients (K, h + n) by knot and shape, as `LinearSystem.chain`."""
    n = len(g[0]) - h
    chain, shape = np.zeros((len(g) - 1, 2 * h + n + 1, 2 * h + n + 1)), np.arange(2 * h, 2 * h + n)
    for knots, intervals, at in ((slice(0, -1), slice(None), 0), (slice(-1, None), slice(-1, None), h)):
        columns = np.append(np.arange(at, at + h), shape)
        chain[intervals, columns[:, None], columns] += H[knots]
        chain[intervals, columns, -1] += g[knots]
    return chain


def start_points(problem: Problem, state: State, background: BackgroundPoints) -> tuple[Problem, State]:
    """The problem with those background points that a state's cameras locate, and the state with their positions."""
    points = _nearest_to_rays(problem, state, background)
    known = np.asarray(np.isfinite(points).all(axis=1))
    rows = np.flatnonzero(known[background.point])
    problem = replace(problem, background=background.select(rows))
    return problem, locate_points_robustly(problem, replace(state, points=points[known]))


def locate_points(problem: Problem, state: State, used: Mask) -> State:
    """The state with points that are optimal for its cameras, by Gauss-Newton from its own, from the images `used`."""
    for _ in range(POINT_STEPS if len(state.points) else 0):
        state = _step_points(problem, state, used.astype(float))
    return state


def locate_points_robustly(problem: Problem, state: State) -> State:
    """The same from all images, with Cauchy's weights at a scale that the residuals give."""
    for _ in range(STEPS if len(state.points) else 0):
        norms = point_error_norms(problem, state)
        scale = CAUCHY_SCALE * max(coordinate_sigma(norms), 1.0)
        state = _step_points(problem, state, cauchy_weights(norms, scale))
    return state


def point_error_norms(problem: Problem, state: State) -> Array:
    """(n,) norms of the whitened reprojection errors of all images."""
    return np.linalg.norm(_linearize_images(problem, state)[0], axis=1)


def point_residuals(problem: Problem, state: State) -> Array:
    """(n, 2) reprojection errors of all images, pixels; NaN behind the camera."""
    background, errors = problem.background, np.empty_like(problem.background.uv)
    for c, lens in enumerate(problem.lenses):
        rows, T = background.camera == c, state.cameras[c]
        local = (state.points[background.point[rows]] - T[:3, 3]) @ T[:3, :3]
        errors[rows] = background.uv[rows] - state.lens(c, lens).project(local)
    return errors


def accept_images(problem: Problem, norms: Array, limit: float) -> Mask:
    """(n,) images whose errors are below `limit` sigmas, of points that have two or more of these."""
    accepted = norms < limit
    count = np.bincount(problem.background.point[accepted], minlength=len(problem.background))
    return accepted & (count >= 2)[problem.background.point]


def eliminate_points(problem: Problem, state: State, used: Mask) -> tuple[Array, Array]:
    """`LinearSystem.by_points` and `point_scores` from the images `used` (n,)."""
    C, d, n = len(problem.lenses), len(problem.free), len(problem.background)
    own, scores, crossed = np.zeros((C, d, C, d)), np.zeros((n, C, d)), np.zeros((n, C, 3, d))
    if not used.any():
        return own, scores
    point, camera = problem.background.point[used], problem.background.camera[used]
    error, J_camera, J_point = (part[used] for part in _linearize_images(problem, state))
    for c in range(C):
        J = J_camera[camera == c].reshape(-1, d)
        own[c, :, c] = J.T @ J
    H, g = _point_equations(n, point, error, J_point, np.ones(len(point)))
    crossed[point, camera] = J_point.mT @ J_camera
    scores[point, camera] = (J_camera.mT @ error[:, :, None])[:, :, 0]
    crossed = np.swapaxes(crossed, 1, 2).reshape(n, 3, C * d)
    response = np.linalg.solve(H, crossed)
    lost = crossed.reshape(3 * n, -1).T @ response.reshape(3 * n, -1)
    along = (g[:, None] @ response)[:, 0]
    return own - lost.reshape(own.shape), scores - along.reshape(scores.shape)


def _point_equations(n: int, point: Index, error: Array, J: Array, weight: Array) -> tuple[Array, Array]:
    """Hessians (n, 3, 3), regular, and gradients (n, 3) of the points by the weighted errors of their images."""
    H, g = np.zeros((n, 3, 3)), np.zeros((n, 3))
    np.add.at(H, point, weight[:, None, None] * J.mT @ J)
    np.add.at(g, point, weight[:, None] * (J.mT @ error[:, :, None])[:, :, 0])
    regular = REGULAR * np.einsum("jii->j", H)[:, None, None] + np.finfo(float).tiny
    return H + regular * np.eye(3), g


def _linearize_images(problem: Problem, state: State) -> tuple[Array, Array, Array]:
    """Whitened errors (n, 2) of all images, observed less predicted, and the derivatives of the predicted ones by the
    camera's free parameters (n, 2, d) and by the point (n, 2, 3), 0 behind the camera."""
    background = problem.background
    n, points = len(background.uv), state.points[background.point]
    error, J_point, J_camera = np.empty((n, 2)), np.empty((n, 2, 3)), np.zeros((n, 2, PER_CAMERA))
    for c in np.unique(background.camera).tolist():
        rows, T = np.flatnonzero(background.camera == c), state.cameras[c]
        lens = state.lens(c, problem.lenses[c])
        uv, J, J_pose, J_lens = pixel_jacobians(lens, (points[rows] - T[:3, 3]) @ T[:3, :3])
        error[rows], J_point[rows] = background.uv[rows] - uv, J @ T[:3, :3].T
        J_camera[rows, :, :6], J_camera[rows, :, LENS[0] :] = J_pose, J_lens
    root = np.linalg.inv(np.linalg.cholesky(background.cov))
    errors = np.nan_to_num((root @ error[:, :, None])[:, :, 0], nan=BEHIND)
    J_camera = J_camera[:, :, list(problem.free)]
    return errors, _known(root @ J_camera), _known(root @ J_point)


def _step_points(problem: Problem, state: State, weight: Array) -> State:
    """One step of Gauss-Newton for all points, with weights (n,) of the images."""
    error, _, J = _linearize_images(problem, state)
    H, g = _point_equations(len(state.points), problem.background.point, error, J, weight)
    step = np.linalg.solve(H, g[:, :, None])[:, :, 0]
    return replace(state, points=state.points + step)


def _nearest_to_rays(problem: Problem, state: State, background: BackgroundPoints) -> Array:
    """(J, 3) the points nearest to their rays, robustly; NaN where these are nearly parallel."""
    xy = np.full((len(problem.lenses), 1, len(background), 2), np.nan)
    for c, given in enumerate(problem.lenses):
        rows = background.camera == c
        xy[c, 0, background.point[rows]] = state.lens(c, given).normalise(background.uv[rows])
    return intersect_images(xy, state.cameras)[0][0]


def _known(values: Array) -> Array:
    """The values, zeros behind a camera, where they are NaN; `np.nan_to_num` takes twice as long."""
    return np.where(np.isfinite(values), values, 0.0)
