# SPDX-License-Identifier: BSD-3-Clause
"""The least squares problem of a bundle adjustment, linearised in numpy and handed to GTSAM as factors."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.trajectory import MAX_GAP_S, AffineWand, interpolate, whitened_motion
from camera_node.lens import Lens
from camera_node.pose import rotation_from_vector

Array = NDArray[np.float64]
Index = NDArray[np.intp]

LENGTH_SIGMA_M = 0.0005  # to which a wand is made
SPEED_SIGMA = 3.0  # metres per second: a waving hand
ANCHOR = 1e8  # information that holds the first camera during a step: about what its observations give


@dataclass(frozen=True, slots=True)
class Observations:
    """Marker centres, one row each, sorted by view.

    Attributes:
        camera: (n,) index of the camera.
        knot: (n,) the instant they belong to.
        view: (n,) the frame they are from, ascending.
        label: (n,) marker of the wand.
        t_s: (n,) capture time, seconds.
        uv: (n, 2) raw pixels, where the disc's own centre is seen.
        root: (n, 2, 2) square root of the inverse covariance of `uv`.
    """

    camera: Index
    knot: Index
    view: Index
    label: Index
    t_s: Array
    uv: Array
    root: Array

    def __len__(self) -> int:
        return len(self.uv)

    def select(self, rows: NDArray) -> "Observations":
        """The rows that a mask or an index array names."""
        return Observations(*(getattr(self, name)[rows] for name in self.__slots__))


@dataclass(frozen=True, slots=True)
class State:
    """The unknowns: T_world_cam (C, 4, 4); position and velocity (K, 2, B, 3) of the wand's basis markers at knots."""

    cameras: Array
    motion: Array

    def moved(self, by: Array, along: Array) -> "State":
        """Cameras turned and shifted by `by` (C, 6) in their own frames, the motion by `along` (K, 6 B)."""
        cameras = self.cameras.copy()
        for T, xi in zip(cameras, by, strict=True):
            T[:3, 3] += T[:3, :3] @ xi[3:]
            T[:3, :3] = T[:3, :3] @ rotation_from_vector(xi[:3])
        return State(cameras, self.motion + along.reshape(self.motion.shape))


@dataclass(frozen=True, slots=True)
class Problem:
    """What stays the same from iteration to iteration.

    `fixed_distance` holds two cameras and their distance: it carries the scale where no wand length does.
    """

    lenses: list[Lens]
    wand: AffineWand
    knot_s: Array
    density: float
    fixed_distance: tuple[int, int, float] | None = None


def skew(v: Array) -> Array:
    """(..., 3, 3) the matrix of the cross product with v (..., 3)."""
    S = np.zeros((*v.shape, 3))
    S[..., 0, 1], S[..., 0, 2], S[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return S - np.swapaxes(S, -1, -2)


class Linearisation:
    """The least squares problem around a state, as GTSAM factors: keys are cameras 0..C-1, then knots."""

    def __init__(self, problem: Problem, observations: Observations) -> None:
        import gtsam

        self.gtsam: Any = gtsam
        self.problem, self.observations = problem, observations
        self.knots, self.hermite = interpolate(problem.knot_s, observations.t_s, observations.knot)
        self.weights = problem.wand.weights[observations.label]
        self.starts = np.flatnonzero(np.diff(observations.view, prepend=-1))
        dt = np.diff(problem.knot_s)
        self.links = np.flatnonzero((dt <= MAX_GAP_S) & (dt > 0))
        self.smooth = np.array([whitened_motion(dt[k], problem.density) for k in self.links]).reshape(
            -1, 2, 4
        )
        self.models = {}
        self.graph: Any = None

    def positions(self, state: State) -> Array:
        """Where the observed markers were when they were observed, (n, 3), world."""
        ends = state.motion[self.knots].reshape(len(self.knots), 4, -1, 3)
        return np.einsum("nh,nb,nhbx->nx", self.hermite, self.weights, ends)

    def residuals(self, state: State) -> Array:
        """Seen less expected (n, 2), pixels; NaN behind the camera."""
        points, seen = self.positions(state), self.observations
        out = np.empty((len(seen), 2))
        for c, lens in enumerate(self.problem.lenses):
            rows = seen.camera == c
            T = state.cameras[c]
            out[rows] = seen.uv[rows] - lens.project((points[rows] - T[:3, 3]) @ T[:3, :3])
        return out

    def whitened(self, state: State) -> Array:
        """Residuals in units of their standard deviation (n, 2); 1e4 behind the camera."""
        return np.nan_to_num(np.einsum("nij,nj->ni", self.observations.root, self.residuals(state)), nan=1e4)

    def cost(self, state: State, scale: float) -> float:
        """Half of the summed squares, those of observations under Cauchy's kernel at `scale`."""
        squares = (self.whitened(state) ** 2).sum(axis=1)
        robust = squares.sum() if np.isinf(scale) else (scale**2 * np.log1p(squares / scale**2)).sum()
        return 0.5 * float(robust + sum((term**2).sum() for term in self._priors(state)))

    def _priors(self, state: State) -> list[Array]:
        wand, motion = self.problem.wand, state.motion
        ends = motion[:, 0][:, wand.pairs]
        lengths = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2)
        pairs = np.concatenate([motion[self.links], motion[self.links + 1]], axis=1)
        terms = [
            (lengths - wand.lengths) / LENGTH_SIGMA_M,
            motion[:, 1] / SPEED_SIGMA,
            np.einsum("lij,ljbx->libx", self.smooth, pairs),
        ]
        if self.problem.fixed_distance:
            a, b, distance = self.problem.fixed_distance
            gap = state.cameras[a, :3, 3] - state.cameras[b, :3, 3]
            terms.append(np.array([np.linalg.norm(gap) / distance - 1]) / 1e-6)
        return terms

    def relinearise(self, state: State, weight: Array) -> None:
        """Build the factors around `state`, each observation weighted by `weight` (n,)."""
        self.graph = self.gtsam.GaussianFactorGraph()
        self._add_observations(state, np.sqrt(weight))
        self._add_priors(state)

    def _add(self, blocks: list[tuple[int, Array]], b: Array) -> None:
        unit = self.models.setdefault(len(b), self.gtsam.noiseModel.Unit.Create(len(b)))
        flat = [part for block in blocks for part in block]
        self.graph.add(self.gtsam.JacobianFactor(*flat, b, unit))

    def _add_observations(self, state: State, weight: Array) -> None:
        seen, n, count = self.observations, len(self.observations), len(self.problem.lenses)
        points = self.positions(state)
        J_camera, J_point, error = np.zeros((n, 2, 6)), np.zeros((n, 2, 3)), np.zeros((n, 2))
        for c, lens in enumerate(self.problem.lenses):
            rows = seen.camera == c
            T = state.cameras[c]
            local = (points[rows] - T[:3, 3]) @ T[:3, :3]
            uv, J = lens.project_with_jacobian(local)
            J = np.nan_to_num(J)
            J_camera[rows] = np.concatenate([J @ skew(local), -J], axis=2)
            J_point[rows] = J @ T[:3, :3].T
            error[rows] = np.nan_to_num(seen.uv[rows] - uv)
        root = weight[:, None, None] * seen.root
        J_camera, J_point = root @ J_camera, root @ J_point
        error = np.einsum("nij,nj->ni", root, error)
        J_knots = np.einsum("nrx,nh,nb->nrhbx", J_point, self.hermite, self.weights).reshape(n, 2, 2, -1)
        for first, last in zip(self.starts, [*self.starts[1:], n], strict=True):
            k, after = self.knots[first]
            blocks = [
                (int(seen.camera[first]), J_camera[first:last].reshape(-1, 6)),
                (count + int(k), J_knots[first:last, :, 0].reshape(2 * (last - first), -1)),
            ]
            if after != k:
                blocks.append((count + int(after), J_knots[first:last, :, 1].reshape(2 * (last - first), -1)))
            self._add(blocks, error[first:last].ravel())

    def _add_priors(self, state: State) -> None:
        wand, motion, count = self.problem.wand, state.motion, len(self.problem.lenses)
        B, K = len(wand.basis), len(motion)
        terms = self._priors(state)
        J = np.zeros((K, len(wand.pairs) + 3 * B, 2, B, 3))
        for e, (i, j) in enumerate(wand.pairs):
            gap = motion[:, 0, i] - motion[:, 0, j]
            along = gap / np.linalg.norm(gap, axis=1, keepdims=True) / LENGTH_SIGMA_M
            J[:, e, 0, i], J[:, e, 0, j] = along, -along
        J[:, len(wand.pairs) :, 1] = (np.eye(3 * B) / SPEED_SIGMA).reshape(1, 3 * B, B, 3)
        error = -np.concatenate([terms[0], terms[1].reshape(K, -1)], axis=1)
        for k, (A, b) in enumerate(zip(J.reshape(K, -1, 6 * B), error, strict=True)):
            self._add([(count + k, A)], b)
        for k, S, e in zip(self.links.tolist(), self.smooth, terms[2], strict=True):
            A = np.einsum("ij,pq->ipjq", S, np.eye(3 * B)).reshape(6 * B, 2, 6 * B)
            self._add([(count + k, A[:, 0]), (count + k + 1, A[:, 1])], -e.ravel())
        if self.problem.fixed_distance:
            self._add_distance(state, *self.problem.fixed_distance, terms[3])

    def _add_distance(self, state: State, a: int, b: int, distance: float, error: Array) -> None:
        gap = state.cameras[a, :3, 3] - state.cameras[b, :3, 3]
        along = gap / np.linalg.norm(gap) / distance / 1e-6
        zero = np.zeros((1, 3))
        blocks = [
            (c, np.hstack([zero, sign * along[None] @ state.cameras[c, :3, :3]]))
            for c, sign in ((a, 1), (b, -1))
        ]
        self._add(blocks, -error)

    def solve(self, damping: float) -> tuple[Array, Array]:
        """The damped step: (C, 6) of cameras and (K, 6 B) of the motion; the first camera stays, as nothing observes
        the world.

        Raises:
            RuntimeError: the system is too near to singular; more damping helps.
        """
        graph = self.graph.clone()
        count, knots = len(self.problem.lenses), len(self.problem.knot_s)
        dims = [6] * count + [6 * len(self.problem.wand.basis)] * knots
        diagonal = np.sqrt([ANCHOR] + [damping] * (len(dims) - 1))
        for key, (dim, weight) in enumerate(zip(dims, diagonal, strict=True)):
            model = self.models.setdefault(dim, self.gtsam.noiseModel.Unit.Create(dim))
            graph.add(self.gtsam.JacobianFactor(key, weight * np.eye(dim), np.zeros(dim), model))
        step = graph.optimize()
        return (
            np.array([step.at(key) for key in range(count)]),
            np.array([step.at(count + k) for k in range(knots)]),
        )

    def camera_information(self, state: State) -> Array:
        """(6C, 6C) information of the cameras with the motion eliminated (Schur complement)."""
        self.relinearise(state, np.ones(len(self.observations)))
        count, knots = len(self.problem.lenses), len(self.problem.knot_s)
        rest = self.graph.eliminatePartialMultifrontal(list(range(count, count + knots)))[1]
        order = self.gtsam.Ordering()
        for key in range(count):
            order.push_back(key)
        return np.asarray(rest.hessian(order)[0])
