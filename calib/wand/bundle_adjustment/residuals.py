# SPDX-License-Identifier: BSD-3-Clause
"""The residuals of the wand's bundle adjustment, and what whitens them.

Residuals are the reprojection errors of marker centres at their own capture times, deviations of the motion from
constant velocity, of the wand from its lengths, and of cameras from their priors. See docs/design/wand_adjustment.md.
"""

from dataclasses import dataclass, replace

import numpy as np

from calib.rig.camera import POSE
from calib.wand.bundle_adjustment.eliminated_points import BEHIND, point_error_norms
from calib.wand.bundle_adjustment.problem import Problem, State, WandObservations
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
    lenses = [state.lens(c, lens) for c, lens in enumerate(problem.lenses)]
    J = np.nan_to_num(point_jacobians(lenses, state.cameras, observations.camera, motion.points)[1])
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
    """

    t_s: Array
    location: SplineLocation
    hermite: Array
    ends: Array

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
    weights = problem.wand.weights[observations.label]
    marker = (weights[:, None, None] @ ends)[:, :, 0]
    return MarkerMotion(t_s, location, position_weights(knot_s, t_s, location), marker)


def reprojection_errors(problem: Problem, observations: WandObservations, state: State) -> Array:
    """(n, 2) observed minus predicted pixels; NaN behind the camera."""
    points = predict_markers(problem, observations, state).points
    errors = np.empty((len(observations), 2))
    for c, lens in enumerate(problem.lenses):
        rows, T = observations.camera == c, state.cameras[c]
        local = (points[rows] - T[:3, 3]) @ T[:3, :3]
        errors[rows] = observations.uv[rows] - state.lens(c, lens).project(local)
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
    wand, motion = problem.wand, state.motion
    pairs = np.concatenate([motion[:-1], motion[1:]], axis=1)
    ends = motion[:, 0][:, wand.pairs]
    lengths = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2)
    smooth = np.einsum("lij,ljbx->libx", weights.motion, pairs)
    return smooth, (lengths - wand.lengths) / LENGTH_SIGMA_M, motion[:, 1] / SPEED_SIGMA


@dataclass(frozen=True, slots=True)
class CameraPrior:
    """A linearized prior factor on one or two `cameras`: whitened `jacobians` (r, d), one a camera, and minus the
    whitened `error` (r,)."""

    cameras: tuple[int, ...]
    jacobians: tuple[Array, ...]
    error: Array


def camera_priors(problem: Problem, state: State) -> list[CameraPrior]:
    """The priors of all cameras' free parameters, and of the distance that fixes the scale, at a state."""
    free, poses = list(problem.free), np.zeros((len(state.cameras), len(POSE)))
    values = np.column_stack([poses, state.clocks, state.lenses])[:, free]
    priors = [
        CameraPrior((c,), (np.diag(1 / sigma),), -value / sigma)
        for c, (value, sigma) in enumerate(zip(values, problem.prior_sigma(), strict=True))
    ]
    if problem.fixed_distance:
        a, b, distance = problem.fixed_distance
        gap = state.cameras[a, :3, 3] - state.cameras[b, :3, 3]
        along = gap / np.linalg.norm(gap) / distance / SCALE_SIGMA
        J = np.zeros((2, 1, len(free)))
        J[0, 0, 3:6], J[1, 0, 3:6] = along @ state.cameras[a, :3, :3], -along @ state.cameras[b, :3, :3]
        error = np.array([1 - float(np.linalg.norm(gap)) / distance]) / SCALE_SIGMA
        priors.append(CameraPrior((a, b), tuple(J), error))
    return priors


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
        smooth = self.size * _cauchy(self.interval**2, interval_scale)
        return 0.5 * float(_cauchy(self.observation**2, observation_scale) + smooth + self.rest)

    def reweight(self, weights: Weights, observation_scale: float, interval_scale: float) -> Weights:
        """The weights with robust ones of Cauchy's kernel at these scales."""
        observation = 1 / (1 + (self.observation / observation_scale) ** 2)
        return replace(
            weights, observation=observation, interval=1 / (1 + (self.interval / interval_scale) ** 2)
        )


def error_norms(
    problem: Problem, observations: WandObservations, state: State, weights: Weights
) -> ErrorNorms:
    """Evaluate all residuals at a state."""
    smooth, lengths, speed = motion_errors(problem, state, weights)
    size = 6 * len(problem.wand.basis)
    interval = np.sqrt((smooth**2).sum(axis=(1, 2, 3)) / size)
    priors = (prior.error for prior in camera_priors(problem, state))
    beside = point_error_norms(problem, state)[weights.background]
    rest = sum((term**2).sum() for term in (lengths, speed, beside, *priors))
    pixel = whitened_errors(problem, observations, state, weights)
    return ErrorNorms(np.linalg.norm(pixel, axis=1), interval, size, float(rest))


def _cauchy(squares: Array, scale: float) -> float:
    """Sum of squares under Cauchy's kernel; plain where `scale` is infinite."""
    return float(squares.sum() if np.isinf(scale) else (scale**2 * np.log1p(squares / scale**2)).sum())
