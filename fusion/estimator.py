# SPDX-License-Identifier: BSD-3-Clause
"""The estimator: one factor graph a robot and instant, eliminated by GTSAM (a lag-1 filter).

    posterior of the last instant -- white-noise-on-acceleration motion -- observations of this instant

A robot's observations, each at its own capture time, are linearised in one numpy batch and weighed one by one
(Cauchy); GTSAM gets them as one HessianFactor.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.optics import Discs, Optics, measured_outlines, place
from fusion.state import States, forget_turn, predict

Array = NDArray[np.float64]
CAUCHY = 4.0  # whitened distance at which an observation's weight is halved
NOMINAL_WEIGHT = (
    0.8983  # mean Cauchy weight of Gaussian noise in two dimensions: E[1 / (1 + chi2_2 / CAUCHY^2)]
)
ITERATIONS = 2
STEP = 1e-4  # rad, of the difference quotient of an outline's shape
AXIS_SIGMA_PX = 0.25  # of a measured axis: blur and threshold move it by more than noise does
BEFORE, NOW = gtsam.symbol("x", 0), gtsam.symbol("x", 1)
ORDERING = gtsam.Ordering()
ORDERING.push_back(BEFORE)
ORDERING.push_back(NOW)
UNIT = gtsam.noiseModel.Unit.Create(12)


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """N detections and the discs they are of: uv (N, 2), cov (N, 2, 2), axes_px (N, 2), angle_rad (N,)."""

    discs: Discs
    uv: Array
    cov: Array
    axes_px: Array
    angle_rad: Array

    def __len__(self) -> int:
        return len(self.uv)

    def select(self, rows: NDArray) -> "Observations":
        """The rows that a mask or an index array names."""
        columns = (self.uv, self.cov, self.axes_px, self.angle_rad)
        return Observations(self.discs.select(rows), *(column[rows] for column in columns))


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """N bodies at this instant before its observations: `F` moves an error of the last instant, `Q` is added."""

    before: Array  # (N, 12, 12) covariance at the last instant
    states: States
    F: Array
    Q: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Whitened linear equations A delta = b: A (N, 2, 12), b (N, 2), and the body of each."""

    body: NDArray[np.intp]
    A: Array
    b: Array

    def weights(self) -> Array:
        """(N,) Cauchy weights, scaled so that Gaussian noise keeps its information."""
        return 1 / (1 + np.sum(self.b**2, 1) / CAUCHY**2) / NOMINAL_WEIGHT


class Estimator:
    """Predicts and updates robots.

    Args:
        optics: the rig's cameras.
        densities: (N, 2) of each robot's white acceleration.
        single: (N,) robots of one marker.
    """

    def __init__(self, optics: Optics, densities: Array, single: NDArray[np.bool_]) -> None:
        self.optics = optics
        self.densities = densities
        self.single = single

    def predict(self, states: States, dt: Array) -> Prediction:
        """All robots, `dt` (N,) seconds later."""
        moved, F, Q = predict(states, dt, self.densities, self.single)
        moved = replace(moved, P=np.where(self.single[:, None, None], forget_turn(moved.P), moved.P))
        return Prediction(states.P, moved, F, Q)

    def update(
        self, prediction: Prediction, observations: Observations, iterations: int = ITERATIONS
    ) -> States:
        """Fuse an instant's observations; robots without any stay as predicted."""
        seen = np.unique(observations.discs.body)
        states = prediction.states
        delta = np.zeros((len(states), 12))
        P = states.P.copy()
        shaped = _shaped(observations)
        whiten = np.asarray(np.linalg.inv(np.linalg.cholesky(observations.cov)), float)
        motions = {k: _motion(prediction, k) for k in seen}
        for _ in range(iterations):
            rows = self._linearise(prediction.states.moved(delta), observations, whiten, shaped)
            weights = rows.weights()
            for k in seen:
                mine = rows.body == k
                step, P[k] = _eliminate(motions[k], rows.A[mine], rows.b[mine], weights[mine], delta[k])
                delta[k] += step
        P[self.single] = forget_turn(P[self.single])
        return replace(prediction.states.moved(delta), P=P)

    def errors(self, states: States, observations: Observations) -> tuple[Array, Array]:
        """Reprojection errors (N, 2) in pixels, and their squared Mahalanobis lengths (N,) by detection noise."""
        error = observations.uv - self.optics.view(states, observations.discs).uv
        whitened = np.linalg.solve(np.linalg.cholesky(observations.cov), error[:, :, None])[:, :, 0]
        return error, np.sum(whitened**2, 1)

    def _linearise(
        self, states: States, observations: Observations, whiten: Array, shaped: NDArray[np.bool_]
    ) -> _Rows:
        views = self.optics.view(states, observations.discs)
        b = (whiten @ (observations.uv - views.uv)[:, :, None])[:, :, 0]
        known = np.isfinite(b).all(1)
        rows = _Rows(observations.discs.body[known], (whiten @ views.jacobian)[known], b[known])
        shaped = shaped & known
        if not shaped.any():
            return rows
        shapes = self._linearise_shapes(states, observations.select(shaped))
        return _Rows(*(np.concatenate([getattr(rows, f), getattr(shapes, f)]) for f in rows.__slots__))

    def _linearise_shapes(self, states: States, seen: Observations) -> _Rows:
        """How an outline is stretched tells the normal where few markers do; its size, prone to blur, is left out."""
        R, _, normal, centre = place(states, seen.discs)
        # (n, 3, 3): as it is, and turned a little about the body's x and y
        normals = normal[:, None] + STEP * np.stack([0 * normal, -R[:, :, 1], R[:, :, 0]], 1)
        of = np.repeat(np.arange(len(seen)), 3)
        expected = self.optics.outlines(
            seen.discs.camera[of], centre[of], normals.reshape(-1, 3), seen.discs.radius[of]
        )
        stretch = shears(measured_outlines(seen.axes_px, seen.angle_rad)[of], expected).reshape(-1, 3, 2)
        A = np.zeros((len(seen), 2, 12))
        A[:, :, :2] = -(stretch[:, 1:] - stretch[:, :1]).transpose(0, 2, 1) / STEP
        sigma = 2 * np.hypot(AXIS_SIGMA_PX, 2 * np.sqrt(seen.cov[:, 0, 0])) / seen.axes_px[:, 1]
        return _Rows(seen.discs.body, A / sigma[:, None, None], stretch[:, 0] / sigma[:, None])


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """What the last instant tells of a body at this one: its information there, and whitened F and identity."""

    information: Array
    F: Array
    identity: Array


def _motion(prediction: Prediction, k: int) -> _Motion:
    whiten = np.linalg.inv(np.linalg.cholesky(prediction.Q[k]))
    return _Motion(np.linalg.inv(prediction.before[k]), whiten @ prediction.F[k], whiten)


def _eliminate(motion: _Motion, A: Array, b: Array, weights: Array, delta: Array) -> tuple[Array, Array]:
    """The correction (12,) of a robot about its prediction displaced by `delta`, and its covariance."""
    A, b = A.reshape(-1, 12), b.reshape(-1)
    weighted = np.repeat(weights, 2)[:, None] * A
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(gtsam.HessianFactor(BEFORE, motion.information, np.zeros(12), 0.0))
    graph.push_back(
        gtsam.JacobianFactor(BEFORE, -motion.F, NOW, motion.identity, -motion.identity @ delta, UNIT)
    )
    graph.push_back(gtsam.HessianFactor(NOW, weighted.T @ A, weighted.T @ b, 0.0))
    now = graph.eliminateSequential(ORDERING).at(1)
    root = np.linalg.inv(now.R())
    return root @ now.d(), root @ root.T


def _shaped(observations: Observations) -> NDArray[np.bool_]:
    """(N,) outlines of bodies of which fewer than three markers are seen: their shapes are needed."""
    discs = observations.discs
    places = np.unique(np.column_stack([discs.body, discs.marker]), axis=0)
    seen = np.bincount(places[:, 0].astype(np.intp), minlength=1)
    return (seen[discs.body] < 3) & np.isfinite(observations.axes_px).all(1)


def shears(measured: Array, expected: Array) -> Array:
    """(N, 2) of outlines (N, 2, 2) seen in the frame in which the expected one is a unit circle: 0 if similar.

    The two parts that change no area, divided by the size, each with a variance of 4 (sigma_axis / axis)^2.
    """
    whiten = np.linalg.inv(np.linalg.cholesky(expected))
    S = whiten @ measured @ whiten.transpose(0, 2, 1)
    size = np.trace(S, axis1=1, axis2=2)[:, None] / 2
    return np.stack([S[:, 0, 0] - S[:, 1, 1], 2 * S[:, 0, 1]], -1) / np.sqrt(2) / size
