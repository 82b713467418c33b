# SPDX-License-Identifier: BSD-3-Clause
"""The estimator: a factor graph an instant, eliminated by GTSAM (a lag-1 filter).

    posterior of the last instant -- white-noise-on-acceleration motion -- observations of this instant

All robots are one graph, of which each is a part of its own. What the last posterior and the motion say together is one
HessianFactor a robot, what its observations say another; those, each at its own capture time, are linearised in one
numpy batch over all robots and weighed one by one (Cauchy).
"""

from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.optics import Optics, measured_outlines, outlines
from fusion.sightings import Observations
from fusion.state import OMEGA, States, forget_turn, predict

Array = NDArray[np.float64]
Index = NDArray[np.intp]
CAUCHY = 4.0  # whitened distance at which an observation's weight is halved
NOMINAL_WEIGHT = (
    0.8983  # mean Cauchy weight of Gaussian noise in two dimensions: E[1 / (1 + chi2_2 / CAUCHY^2)]
)
ITERATIONS = 8  # at the most
REWEIGHTINGS = 4  # by one linearisation at the most; two mostly
SETTLED = 0.1  # change of a weight that ends them
SMALL = 0.03  # rad and m of a correction that leaves less than a detection's noise of second order
STEP = 1e-4  # rad, of the difference quotient of an outline's shape
STEADY_S = 0.02  # for which a velocity is taken as constant: half a period of a slow camera
AXIS_SIGMA_PX = 0.25  # of a measured axis: blur and threshold move it by more than noise does


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """N bodies at this instant before its observations: `F` moves an error of the last instant, `Q` is added."""

    before: Array  # (N, 12, 12) covariance at the last instant
    states: States
    F: Array
    Q: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Whitened linear equations A delta = b, columns last: A (2, 12, N), b (2, N), and the body of each.

    What can't be seen has A = b = 0.
    """

    body: Index
    A: Array
    b: Array

    def joined(self, other: "_Rows") -> "_Rows":
        """Both."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in self.__slots__)
        return _Rows(*(np.concatenate(pair, axis=-1) for pair in pairs))


class _System:
    """The equations of B bodies side by side (B, S, 2, 13): A and b, zeros where a body has fewer than S."""

    def __init__(self, rows: _Rows, n_bodies: int) -> None:
        count = np.bincount(rows.body, minlength=n_bodies)
        order = np.argsort(rows.body, kind="stable")
        place = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
        size = int(count.max())
        self._at = np.empty(len(order), np.intp)
        self._at[order] = rows.body[order] * size + place
        table = np.zeros((n_bodies * size, 2, 13))
        table[self._at, :, :12] = rows.A.transpose(2, 0, 1)
        table[self._at, :, 12] = rows.b.T
        self._table = table.reshape(n_bodies, size, 2, 13)
        self.shape = (n_bodies, size)

    def normal_equations(self, weights: Array) -> tuple[Array, Array]:
        """(B, 12, 12) information and (B, 12) right sides, by weights (B, S)."""
        B = len(weights)
        flat = self._table.reshape(B, -1, 13)
        product = (self._table * weights[:, :, None, None]).reshape(B, -1, 13).transpose(0, 2, 1) @ flat
        return product[:, :12, :12], product[:, :12, 12]

    def remainder(self, step: Array) -> Array:
        """(B, S, 2) whitened: what steps (B, 12) leave of b."""
        B, S = self.shape
        by = np.concatenate([-step, np.ones((B, 1))], 1)[:, :, None]
        return (self._table.reshape(B, 2 * S, 13) @ by).reshape(B, S, 2)

    def remainder_of_rows(self, step: Array) -> Array:
        """(2, N) the same, in the order of the rows."""
        return self.remainder(step).reshape(-1, 2)[self._at].T


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Errors `delta` (N, 12) of all bodies; of the K seen the last step (K, 12), information and weights.

    `remainder` (2, N) is whitened, in the order of the rows.
    """

    delta: Array
    step: Array
    information: Array
    weights: Array
    remainder: Array


def _weights(remainder: Array) -> Array:
    """(B, S) Cauchy weights, scaled so that Gaussian noise keeps its information."""
    x, y = remainder[..., 0], remainder[..., 1]
    return 1 / (NOMINAL_WEIGHT + (NOMINAL_WEIGHT / CAUCHY**2) * (x * x + y * y))


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
        moved.P[self.single] = forget_turn(moved.P[self.single])
        return Prediction(states.P, moved, F, Q)

    def update(
        self, prediction: Prediction, observations: Observations, small: float = SMALL
    ) -> tuple[States, Array]:
        """Fuse an instant's observations; robots without any stay as predicted.

        Args:
            prediction: the robots before.
            observations: of this instant.
            small: rad and m; after a larger correction everything is linearised anew.

        Returns:
            the states, and what remains of each observation (2, N), pixels; NaN where it can't be seen.
        """
        states, n = prediction.states, len(prediction.states)
        seen = np.flatnonzero(np.bincount(observations.discs.body, minlength=n))
        if not len(seen):
            return states, np.empty((2, 0))
        observations = self._loosened(states, observations)
        prior, shaped = np.asarray(np.linalg.inv(states.P[seen]), float), _shaped(observations)
        solve = partial(self._solve, observations, shaped, seen, prior)
        solution = solve(states, np.zeros((n, 12)), None)
        for _ in range(ITERATIONS - 1):
            if np.max(np.abs(solution.step[:, :6])) < small:
                break
            solution = solve(states.moved(solution.delta), solution.delta, solution.weights)
        P = states.P.copy()
        P[seen] = np.linalg.inv(solution.information)
        P[self.single] = forget_turn(P[self.single])
        return replace(states.moved(solution.delta), P=P), _in_pixels(observations, solution.remainder)

    def _solve(
        self,
        observations: Observations,
        shaped: Index,
        seen: Index,
        prior: Array,
        at: States,
        delta: Array,
        weights: Array | None,
    ) -> "_Solution":
        """Linearise once about the states `at`, which are displaced by `delta` (N, 12), weigh and eliminate."""
        row = np.cumsum(np.bincount(seen, minlength=len(at))) - 1
        rows = self._linearise(at, observations, shaped)
        system = _System(replace(rows, body=row[rows.body]), len(seen))
        displaced = (prior @ delta[seen, :, None])[:, :, 0]
        weights = np.ones(system.shape) if weights is None else weights
        for _ in range(REWEIGHTINGS):
            H, right = system.normal_equations(weights)
            step = np.linalg.solve(prior + H, (right - displaced)[:, :, None])[:, :, 0]
            before, weights = weights, _weights(system.remainder(step))
            if np.max(np.abs(weights - before), initial=0) < SETTLED:
                break
        H, right = system.normal_equations(weights)
        step = _eliminate(prior + H, right - displaced)
        delta = delta.copy()
        delta[seen] += step
        return _Solution(delta, step, prior + H, weights, system.remainder_of_rows(step))

    def select(self, rows: NDArray) -> "Estimator":
        """The estimator of some of the robots."""
        return Estimator(self.optics, self.densities[rows], self.single[rows])

    def _loosened(self, states: States, observations: Observations) -> Observations:
        """Late detections, their noise grown by what the body may have done since.

        Within `STEADY_S` of the instant a velocity is taken as constant; over longer times white acceleration of
        density q moves a marker by q tau^3 / 3.
        """
        tau = np.abs(observations.seen.tau)
        if not (tau > STEADY_S).any():
            return observations
        late = np.maximum(tau - STEADY_S, 0)
        q_turn, q = self.densities[observations.discs.body].T
        arm2 = np.einsum("in,in->n", observations.discs.marker, observations.discs.marker)
        poses = self.optics.pose(states, observations.seen.exposures)
        z = self.optics.view(poses, observations.discs).centre[2]
        scale = observations.seen.scale
        moved = np.einsum("ian,jan->ijn", scale, scale) * ((q + q_turn * arm2) * late**3 / 3 / z**2)
        seen = replace(observations.seen, cov=observations.seen.cov + moved)
        return Observations.seeing(seen, observations.discs)

    def _linearise(self, states: States, observations: Observations, shaped: Index) -> _Rows:
        """Rows of the observations in their order, then rows of the outlines `shaped`."""
        discs, seen = observations.discs, observations.seen
        poses = self.optics.pose(states, seen.exposures)
        views = self.optics.view(poses, discs)
        A = self.optics.derive(poses, seen.exposures, discs, views, observations.whiten)
        A[:, OMEGA, self.single[discs.body]] = 0  # one marker's turning rate would but fit its noise
        x, y = seen.xy - views.xy
        b = observations.whiten[:, 0] * x + observations.whiten[:, 1] * y
        unseen = ~np.isfinite(b[0])
        if unseen.any():
            A[..., unseen] = b[:, unseen] = 0
            shaped = shaped[~unseen[shaped]]
        rows = _Rows(discs.body, A, b)
        return (
            rows.joined(self._linearise_shapes(states, observations.select(shaped))) if len(shaped) else rows
        )

    def _linearise_shapes(self, states: States, observations: Observations) -> _Rows:
        """How an outline is stretched tells the normal where few markers do; its size, prone to blur, is left out."""
        seen, discs = observations.seen, observations.discs
        poses = self.optics.pose(states, seen.exposures)
        R, views = poses.R_cam[..., poses.columns(discs)], self.optics.view(poses, discs)
        measured = measured_outlines(seen.axes_px, seen.angle_rad)
        turned = (views.normal, views.normal - STEP * R[:, 1], views.normal + STEP * R[:, 0])
        at, about_x, about_y = (
            shears(measured, outlines(views.centre, normal, discs.radius, seen.scale)) for normal in turned
        )
        A = np.zeros((2, 12, len(discs)))
        A[:, 0], A[:, 1] = (at - about_x) / STEP, (at - about_y) / STEP
        sigma = 2 * np.hypot(AXIS_SIGMA_PX, 2 * np.sqrt(seen.cov[0, 0])) / seen.axes_px[1]
        return _Rows(discs.body, A / sigma, at / sigma)


def misfit(observations: Observations, remainder: Array, slack_px: float) -> Array:
    """(N,) squared errors of observations in standard deviations, to which `slack_px` is added; inf if unseen."""
    cov = observations.seen.cov
    d2 = np.sum(remainder**2, 0) / ((cov[0, 0] + cov[1, 1]) / 2 + slack_px**2)
    return np.nan_to_num(d2, nan=np.inf)


def mean_of_bodies(values: NDArray, body: Index, n_bodies: int) -> Array:
    """(B,) means of values (N,) of bodies (N,); 0 where a body has none."""
    return np.bincount(body, values, n_bodies) / np.maximum(np.bincount(body, minlength=n_bodies), 1)


def _eliminate(information: Array, right: Array) -> Array:
    """(K, 12) corrections of K robots, by one elimination of all."""
    graph, ordering = gtsam.GaussianFactorGraph(), gtsam.Ordering()
    for k, (H, g) in enumerate(zip(information, right, strict=True)):
        graph.push_back(gtsam.HessianFactor(k, H, g, 0.0))
        ordering.push_back(k)
    return graph.eliminateSequential(ordering).optimize().vector().reshape(-1, 12)


def _in_pixels(observations: Observations, whitened: Array) -> Array:
    """(2, N) of whitened remainders of the observations, which come first (2, N...)."""
    x, y = whitened[:, : len(observations)]
    cov = observations.seen.cov
    u = np.sqrt(cov[0, 0])  # whitened is L^-1 of pixels, L L^T the covariance
    v = cov[0, 1] / u
    error = np.stack([u * x, v * x + np.sqrt(cov[1, 1] - v * v) * y])
    return np.where(np.isfinite(observations.whiten[0, 0]), error, np.nan)


def _shaped(observations: Observations) -> Index:
    """Rows of outlines of bodies of which fewer than three markers are seen: their shapes are needed."""
    discs = observations.discs
    body = np.full(np.max(discs.row, initial=0) + 1, -1)
    body[discs.row] = discs.body
    kinds = np.bincount(body[body >= 0], minlength=1)
    return np.flatnonzero((kinds[discs.body] < 3) & np.isfinite(observations.seen.axes_px[1]))


def shears(measured: Array, expected: Array) -> Array:
    """(2, N) of outlines (N, 2, 2) seen in the frame in which the expected one is a unit circle: 0 if similar.

    The two parts that change no area, divided by the size, each with a variance of 4 (sigma_axis / axis)^2.
    """
    l00 = np.sqrt(expected[:, 0, 0])  # L^-1 M L^-T by L L^T = the expected, written out: called for thousands
    l10 = expected[:, 1, 0] / l00
    l11 = np.sqrt(expected[:, 1, 1] - l10**2)
    a = measured[:, 0, 0] / l00**2
    b = (measured[:, 0, 1] / l00 - l10 * a) / l11
    c = (measured[:, 1, 1] - l10 * (2 * measured[:, 0, 1] / l00 - l10 * a)) / l11**2
    return np.stack([a - c, 2 * b]) / (np.sqrt(0.5) * (a + c))
