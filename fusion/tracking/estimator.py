# SPDX-License-Identifier: BSD-3-Clause
"""The estimator: a factor graph an instant, eliminated by GTSAM (a lag-1 filter).

    posterior of the last instant -- white-noise-on-acceleration motion -- observations of this instant

All robots are one graph, of which each is a part of its own. What the last posterior and the motion say together is one
HessianFactor a robot, what its observations say another; those, each at its own capture time, are linearised and
weighed one by one (Cauchy) by `native/linearisation.cpp` and `native/normal_equations.cpp`.
"""

from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np
from numpy.typing import NDArray

from camera_node.arrays import Array, Index, Mask
from fusion import _core
from fusion.model.camera_array import CameraArray
from fusion.model.observations import MatchedObservations
from fusion.model.states import States, Transition, forget_turn, predict

ITERATIONS = 8  # at the most
SMALL = 0.03  # rad and m of a correction that leaves less than a detection's noise of second order
STEADY_S = 0.02  # for which a velocity is taken as constant: half a period of a slow camera
AXIS_SIGMA_PX = 0.25  # of a measured axis: blur and threshold move it by more than noise does


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """N bodies at this instant before its observations, and how errors moved since the last.

    `information` (N, 12, 12) is the inverse of the states' covariance: made here, before the last detection is there.
    """

    states: States
    information: Array
    motion: Transition


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


class Estimator:
    """Predicts and updates robots.

    Args:
        optics: the rig's cameras.
        densities: (N, 2) of each robot's white acceleration.
        single: (N,) robots of one marker.
    """

    def __init__(self, optics: CameraArray, densities: Array, single: Mask) -> None:
        self.optics = optics
        self.densities = densities
        self.single = single

    def predict(self, states: States, dt: Array) -> Prediction:
        """All robots, `dt` (N,) seconds later."""
        moved, motion = predict(states, dt, self.densities, self.single)
        if self.single.any():
            moved.P[self.single] = forget_turn(moved.P[self.single])
        return Prediction(moved, _core.inverses(moved.P), motion)

    def update(
        self, prediction: Prediction, observations: MatchedObservations, small: float = SMALL
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
        prior = prediction.information[seen]
        solve = partial(self._solve, observations, _shaped(observations), seen, prior)
        solution = solve(states, np.zeros((n, 12)), None)
        for _ in range(ITERATIONS - 1):
            if np.max(np.abs(solution.step[:, :6])) < small:
                break
            solution = solve(states.moved(solution.delta), solution.delta, solution.weights)
        P = states.P.copy()
        P[seen] = _core.inverses(solution.information)
        if self.single.any():
            P[self.single] = forget_turn(P[self.single])
        return replace(states.moved(solution.delta), P=P), _in_pixels(observations, solution.remainder)

    def _solve(
        self,
        observations: MatchedObservations,
        shaped: Index,
        seen: Index,
        prior: Array,
        at: States,
        delta: Array,
        weights: Array | None,
    ) -> "_Solution":
        """Linearise once about the states `at`, which are displaced by `delta` (N, 12), weigh and eliminate."""
        row = np.cumsum(np.bincount(seen, minlength=len(at))) - 1
        body = row[np.concatenate([observations.discs.body, observations.discs.body[shaped]])]
        rows = self._linearise(at, observations, shaped)
        displaced = (prior @ delta[seen, :, None])[:, :, 0]
        weights = np.ones(len(rows)) if weights is None else weights
        information, right, weights = _core.reweigh(rows, body, prior, -displaced, weights)
        step = _eliminate(information, right)
        delta = delta.copy()
        delta[seen] += step
        return _Solution(delta, step, information, weights, _core.remainder(rows, body, step))

    def select(self, rows: NDArray) -> "Estimator":
        """The estimator of some of the robots."""
        return Estimator(self.optics, self.densities[rows], self.single[rows])

    def _loosened(self, states: States, observations: MatchedObservations) -> MatchedObservations:
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
        return MatchedObservations.seeing(seen, observations.discs)

    def _linearise(self, states: States, observations: MatchedObservations, shaped: Index) -> Array:
        """(N + S, 2, 13) rows of the observations, then of the S outlines `shaped`; see `_core.Poses.linearise`."""
        seen = observations.seen
        poses = self.optics.pose(states, seen.exposures)
        of_centre = seen.xy, observations.whiten, self.single
        rows = poses.linearise(*observations.discs.columns, *of_centre)
        if not len(shaped):
            return rows
        discs, seen = observations.discs.select(shaped), seen.select(shaped)
        sigma = 2 * np.hypot(AXIS_SIGMA_PX, 2 * np.sqrt(seen.cov[0, 0])) / seen.axes_px[1]
        of_outline = seen.axes_px, seen.angle_rad, seen.scale, sigma
        return np.concatenate([rows, poses.linearise_outlines(*discs.columns, *of_outline)])


def misfit(observations: MatchedObservations, remainder: Array, slack_px: float) -> Array:
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


def _in_pixels(observations: MatchedObservations, whitened: Array) -> Array:
    """(2, N) of whitened remainders of the observations, which come first (2, N...)."""
    x, y = whitened[:, : len(observations)]
    cov = observations.seen.cov
    u = np.sqrt(cov[0, 0])  # whitened is L^-1 of pixels, L L^T the covariance
    v = cov[0, 1] / u
    error = np.stack([u * x, v * x + np.sqrt(cov[1, 1] - v * v) * y])
    return np.where(np.isfinite(observations.whiten[0, 0]), error, np.nan)


def _shaped(observations: MatchedObservations) -> Index:
    """Rows of outlines of bodies of which fewer than three markers are seen: their shapes are needed."""
    discs = observations.discs
    body = np.full(np.max(discs.row, initial=0) + 1, -1)
    body[discs.row] = discs.body
    kinds = np.bincount(body[body >= 0], minlength=1)
    return np.flatnonzero((kinds[discs.body] < 3) & np.isfinite(observations.seen.axes_px[1]))
