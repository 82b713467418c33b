# SPDX-License-Identifier: BSD-3-Clause
"""The least squares problem of a wand's bundle adjustment, linearised in numpy.

Every observation depends on one camera and on the two knots around its time. All are linearised in one batch; those
of one camera between two knots are the rows of one factor on (knot, next knot, camera).
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib.rig.camera import PER_CAMERA, POSE, SHAPE, pixel_jacobians
from calib.wand.bundle_adjustment.problem import Problem, State, WandObservations
from calib.wand.trajectory import Place, hermite_rate, interpolate, locate, whitened_motion
from camera_node.arrays import Array, Index, Mask

Term = tuple[tuple[int, ...], tuple[Array, ...], NDArray]  # cameras, Jacobians, right-hand side

RIGID_M = 2e-4  # by which a wand bends while it is waved
SPEED_SIGMA = 3.0  # metres per second: a waving hand
STEP_M = 0.5  # about what a place changes by in one step: holds what too few cameras see, and weighs nothing elsewhere
FIXED = 1e-6  # to which a distance that carries the scale is kept


@dataclass(frozen=True, slots=True)
class Errors:
    """How far a state is from what is measured and known, in sigmas.

    Attributes:
        seen: (n,) of the observations.
        strain: (L,) of the motion from constant velocity over each interval, root mean square of `size` numbers.
        rest: sum of squares of all else.
    """

    seen: Array
    strain: Array
    size: int
    rest: float

    def cost(self, scale: float, slack: float) -> float:
        """Half of the summed squares, those of observations under Cauchy's kernel at `scale`, those of the motion's
        smoothness at `slack`; either may be infinite."""
        smooth = self.size * cauchy(self.strain**2, slack)
        return 0.5 * float(cauchy(self.seen**2, scale) + smooth + self.rest)


@dataclass(frozen=True, slots=True)
class _Passage:
    """What was observed, on the trajectory: when (n,), where in it, Hermite weights `h` (n, 4) of positions, and the
    marker's places and velocities at the knots before and after, `ends` (n, 4, 3)."""

    t_s: Array
    place: Place
    h: Array
    ends: Array

    @property
    def points(self) -> Array:
        """(n, 3) world."""
        return (self.h[:, None] @ self.ends)[:, 0]

    def velocity(self, knot_s: Array) -> Array:
        """(n, 3) world."""
        return (hermite_rate(knot_s, self.t_s, self.place)[:, None] @ self.ends)[:, 0]


@dataclass(slots=True)
class Linearisation:
    """The problem with its observations; `relinearise` makes the linear system around a state."""

    problem: Problem
    observations: WandObservations
    broken: Mask | None = None  # (L,) intervals over which the hand was not as smooth as elsewhere
    smooth: Array = field(init=False)  # (L, 2, 4) whitened constant velocity between knots; 0 across gaps
    root: Array = field(init=False)  # (n, 2, 2) whitens residuals
    views: Index = field(init=False)  # (V,) link times C plus camera, ascending
    rows: Array = field(
        init=False
    )  # (2n, m) by view: whitened derivatives by knot, next knot and camera, and errors
    ends: Index = field(init=False)  # (V + 1,) where in `rows` each view begins, and the last one ends
    chain: Array = field(init=False)  # (L, m', m') augmented Hessians of what is known of the motion
    rig: list[Term] = field(init=False)  # of what is known of the cameras

    def __post_init__(self) -> None:
        dt = np.diff(self.problem.knot_s)
        self.smooth = np.zeros((len(dt), 2, 4))
        near = (dt <= self.problem.gap_s) & (dt > 0)
        self.smooth[near] = whitened_motion(dt[near], self.problem.density)
        if self.broken is not None:
            self.smooth[self.broken] = 0.0

    def linked(self) -> int:
        """The number of intervals between knots that are no gaps."""
        return int(self.smooth.any(axis=(1, 2)).sum())

    def times(self, state: State) -> Array:
        """True capture times (n,) as the clocks stand."""
        seen, clocks = self.observations, state.clocks[self.observations.camera]
        return seen.t_s + clocks[:, 0] + clocks[:, 1] * (seen.t_s - self.problem.middle_s)

    def positions(self, state: State) -> Array:
        """Where the observed markers were when they were observed, (n, 3), world."""
        return self._pass(state).points

    def _pass(self, state: State) -> _Passage:
        """Where what was observed was."""
        t_s, knot_s, motion = self.times(state), self.problem.knot_s, state.motion
        place = locate(knot_s, t_s, self.problem.gap_s)
        ends = np.concatenate([motion[place.link], motion[place.link + 1]], axis=1)
        weights = self.problem.wand.weights[self.observations.label]
        marker = (weights[:, None, None] @ ends)[:, :, 0]
        return _Passage(t_s, place, interpolate(knot_s, t_s, place), marker)

    def residuals(self, state: State) -> Array:
        """Seen less expected (n, 2), pixels; NaN behind the camera."""
        points, out = self.positions(state), np.empty((len(self.observations), 2))
        for c, lens in enumerate(self.problem.lenses):
            rows, T = self.observations.camera == c, state.cameras[c]
            local = (points[rows] - T[:3, 3]) @ T[:3, :3]
            out[rows] = self.observations.uv[rows] - state.lens(c, lens).project(local)
        return out

    def weigh(self, state: State) -> None:
        """Set what whitens residuals: the detector's covariance, and what is not known of the motion between knots and
        of when each frame was taken."""
        passage = self._pass(state)
        spread = self.problem.density * passage.place.spread
        J = self._by_point(state, passage.points)
        along = self.observations.stamp_sigma_s[:, None] * passage.velocity(self.problem.knot_s)
        late = J @ along[:, :, None]
        cov = self.observations.cov + spread[:, None, None] * J @ np.swapaxes(J, 1, 2)
        cov += late @ np.swapaxes(late, 1, 2)
        self.root = np.asarray(np.linalg.inv(np.linalg.cholesky(cov)), float)

    def _by_point(self, state: State, points: Array) -> Array:
        """(n, 2, 3) how what is expected changes with the marker's place in the world."""
        J = np.zeros((len(points), 2, 3))
        for c, given in enumerate(self.problem.lenses):
            rows, T = np.flatnonzero(self.observations.camera == c), state.cameras[c]
            local = (points[rows] - T[:3, 3]) @ T[:3, :3]
            J[rows] = np.nan_to_num(state.lens(c, given).project_with_jacobian(local)[1] @ T[:3, :3].T)
        return J

    def select(self, rows: Mask, broken: Mask) -> "Linearisation":
        """The observations that a mask names, whitened as they are here, and intervals `broken` (L,)."""
        kept = Linearisation(self.problem, self.observations.select(rows), broken)
        kept.root = self.root[rows]
        return kept

    def whitened(self, state: State) -> Array:
        """Residuals in units of their standard deviation (n, 2); 1e4 behind the camera."""
        return np.nan_to_num((self.root @ self.residuals(state)[:, :, None])[:, :, 0], nan=1e4)

    def errors(self, state: State) -> "Errors":
        """Everything that is measured or known, against a state."""
        smooth, lengths, speed = self._motion_terms(state)
        size = 6 * len(self.problem.wand.basis)
        strain = np.sqrt((smooth**2).sum(axis=(1, 2, 3)) / size)
        rest = sum((term**2).sum() for term in (lengths, speed, *(t[2] for t in self._rig_terms(state))))
        return Errors(np.linalg.norm(self.whitened(state), axis=1), strain, size, float(rest))

    def _motion_terms(self, state: State) -> tuple[Array, Array, Array]:
        """Whitened: constant velocity (L, 2, B, 3), lengths (K, E), speed (K, B, 3)."""
        wand, motion = self.problem.wand, state.motion
        pairs = np.concatenate([motion[:-1], motion[1:]], axis=1)
        ends = motion[:, 0][:, wand.pairs]
        lengths = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2)
        smooth = np.einsum("lij,ljbx->libx", self.smooth, pairs)
        return smooth, (lengths - wand.lengths) / RIGID_M, motion[:, 1] / SPEED_SIGMA

    def _rig_terms(self, state: State) -> list[Term]:
        """What is known of the cameras before: their numbers, Jacobians, and whitened errors with the sign turned."""
        free = list(self.problem.free)
        zeros = np.zeros((len(state.cameras), len(POSE)))
        shapes = zeros[:, : len(SHAPE)]
        known = np.column_stack([zeros, state.clocks, state.lenses, shapes])[:, free]
        terms: list[Term] = [
            ((c,), (np.diag(1 / sigma),), -values / sigma)
            for c, (values, sigma) in enumerate(zip(known, self.problem.prior_sigma(), strict=True))
        ]
        if self.problem.fixed_distance:
            a, b, distance = self.problem.fixed_distance
            gap = state.cameras[a, :3, 3] - state.cameras[b, :3, 3]
            along = gap / np.linalg.norm(gap) / distance / FIXED
            rows = np.zeros((2, 1, len(free)))
            rows[0, 0, 3:6], rows[1, 0, 3:6] = (
                along @ state.cameras[a, :3, :3],
                -along @ state.cameras[b, :3, :3],
            )
            terms.append(((a, b), tuple(rows), np.array([1 - np.linalg.norm(gap) / distance]) / FIXED))
        return terms

    def _jacobians(self, state: State, passage: _Passage) -> tuple[Array, Array, Array]:
        """Residuals (n, 2), and the derivatives of what is expected by the camera's parameters (n, 2, d) and by the
        marker's place in the world (n, 2, 3)."""
        seen, free = self.observations, list(self.problem.free)
        points, velocity = passage.points, passage.velocity(self.problem.knot_s)
        since = seen.t_s - self.problem.middle_s
        error, J_point = np.zeros((len(seen), 2)), np.zeros((len(seen), 2, 3))
        J_camera = np.zeros((len(seen), 2, PER_CAMERA + len(SHAPE)))
        for c, given in enumerate(self.problem.lenses):
            rows, T, lens = np.flatnonzero(seen.camera == c), state.cameras[c], state.lens(c, given)
            local = (points[rows] - T[:3, 3]) @ T[:3, :3]
            uv, *parts = pixel_jacobians(lens, local)
            J, J_pose, J_lens = (np.nan_to_num(part) for part in parts)
            error[rows] = np.nan_to_num(seen.uv[rows] - uv)
            J_point[rows] = J @ T[:3, :3].T
            J_camera[rows, :, :6], J_camera[rows, :, 8:] = J_pose, J_lens
        J_camera[:, :, 6] = (J_point @ velocity[:, :, None])[:, :, 0]
        J_camera[:, :, 7] = J_camera[:, :, 6] * since[:, None]
        return error, J_camera[:, :, free], J_point

    def relinearise(
        self, state: State, weight: Array | None = None, link_weight: Array | None = None
    ) -> None:
        """Make the system around `state`, observations weighted by `weight` (n,), smoothness by `link_weight` (L,); 1
        each unless given."""
        weight = np.ones(len(self.observations)) if weight is None else weight
        link_weight = np.ones(len(self.smooth)) if link_weight is None else link_weight
        passage = self._pass(state)
        error, J_camera, J_point = self._jacobians(state, passage)
        root = np.sqrt(weight)[:, None, None] * self.root
        weights = self.problem.wand.weights[self.observations.label]
        by_basis = (passage.h[:, :, None] * weights[:, None]).reshape(len(error), 1, -1, 1)
        J_knots = (by_basis * (root @ J_point)[:, :, None]).reshape(len(error), 2, -1)
        rows = np.concatenate([J_knots, root @ J_camera, root @ error[:, :, None]], axis=2)
        view = passage.place.link * len(self.problem.lenses) + self.observations.camera
        order = np.argsort(view, kind="stable")
        first = np.flatnonzero(np.diff(view[order], prepend=-1))
        self.views, self.ends = view[order][first], 2 * np.append(first, len(view))
        self.rows = rows[order].reshape(-1, rows.shape[2])
        self._hold_motion(state, link_weight)
        self.rig = self._rig_terms(state)

    def diagonal(self) -> tuple[Array, Array]:
        """(K, 6 B) and (C, d) of the Hessian: of the knots and of the cameras."""
        half, cameras = 6 * len(self.problem.wand.basis), len(self.problem.lenses)
        squares = np.add.reduceat(self.rows**2, self.ends[:-1])
        link, camera = np.divmod(self.views, cameras)
        of_knots = np.zeros((len(self.problem.knot_s), half))
        of_cameras = np.zeros((cameras, len(self.problem.free)))
        np.add.at(of_knots, link, squares[:, :half])
        np.add.at(of_knots, link + 1, squares[:, half : 2 * half])
        np.add.at(of_cameras, camera, squares[:, 2 * half : -1])
        held = np.einsum("lii->li", self.chain)
        of_knots[:-1] += held[:, :half]
        of_knots[1:] += held[:, half:-1]
        return of_knots, of_cameras

    def _hold_motion(self, state: State, weight: Array) -> None:
        """Hessians of what is known of the motion: knot k stands in link k, the last in the last link."""
        wand, motion = self.problem.wand, state.motion
        smooth, lengths, speed = self._motion_terms(state)
        B, K = len(wand.basis), len(motion)
        local = 12 * B
        self.chain = np.zeros((K - 1, local + 1, local + 1))
        weighted = weight[:, None, None] * self.smooth
        H = np.einsum("lri,lrj->lij", weighted, self.smooth)
        self.chain[:, :local, :local] = np.kron(H, np.eye(3 * B)[None])
        self.chain[:, :local, -1] = -np.einsum("lri,lrbx->libx", weighted, smooth).reshape(K - 1, local)
        J = np.zeros((K, len(wand.pairs) + 3 * B, 2, B, 3))
        for e, (i, j) in enumerate(wand.pairs):
            gap = motion[:, 0, i] - motion[:, 0, j]
            along = gap / np.linalg.norm(gap, axis=1, keepdims=True) / RIGID_M
            J[:, e, 0, i], J[:, e, 0, j] = along, -along
        J[:, len(wand.pairs) :, 1] = (np.eye(3 * B) / SPEED_SIGMA).reshape(1, 3 * B, B, 3)
        J = J.reshape(K, -1, 6 * B)
        error = -np.concatenate([lengths, speed.reshape(K, -1)], axis=1)
        H, g = np.swapaxes(J, 1, 2) @ J, np.einsum("kri,kr->ki", J, error)
        H += np.diag(np.repeat([STEP_M**-2, 0.0], 3 * B))
        for knots, links, at in ((slice(0, -1), slice(None), 0), (slice(-1, None), slice(-1, None), 6 * B)):
            self.chain[links, at : at + 6 * B, at : at + 6 * B] += H[knots]
            self.chain[links, at : at + 6 * B, -1] += g[knots]


def cauchy(squares: Array, scale: float) -> float:
    """Sum of squares under Cauchy's kernel; plain where `scale` is infinite."""
    return float(squares.sum() if np.isinf(scale) else (scale**2 * np.log1p(squares / scale**2)).sum())
