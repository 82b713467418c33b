# SPDX-License-Identifier: BSD-3-Clause
"""Estimates robot states with one factor graph for each frame set, eliminated by GTSAM (a lag-1 filter).

    posterior of the last frame set -- white-noise-on-acceleration motion -- observations of this frame set

The graph has one component for each robot, with two HessianFactors: the predicted posterior, and the observations.
`native/body_fit.cpp` linearizes each observation at its own capture time and weighs it (Cauchy).
See docs/design/fusion_filter.md.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import gtsam
import numpy as np
from numpy.typing import NDArray

from camera_node.foundation.arrays import Array, Mask
from fusion import _core
from fusion.model.observations import (
    EXACT_S,
    Assignments,
    CameraArray,
    DetectionTable,
    LinearizedObservations,
    MatchedObservations,
    Views,
    mean_by_body,
)
from fusion.model.states import OMEGA, VELOCITY, States, Transition, predict, reset_unobservable
from fusion.model.undistortion import COV, OUTLINE
from fusion.tracking.gating import AXIS_SIGMA_PX
from fusion.tracking.headings import linearize_headings, read_headings

MAX_ITERATIONS = 8
SMALL = 0.03  # rad and m; the second-order error of a smaller correction is below the noise of a detection
STEADY_S = 0.02  # during which velocities count as constant: half the period of a slow camera
MIN_SHAPED = 3  # visible markers from which a body does not need the shapes of outlines


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """N bodies at the time of a frame set before its observations, and the transition since the last one.

    `information` (N, 12, 12) is the inverse of the covariance, computed before the last detection arrives.
    """

    states: States
    information: Array
    motion: Transition

    @classmethod
    def without_motion(cls, states: States) -> "Prediction":
        """States at the time of the frame set."""
        n = len(states)
        return cls(states, _core.inverses(states.P), Transition(np.zeros((n, 3, 3)), np.zeros(n)))


@dataclass(frozen=True, slots=True, eq=False)
class AssignedFrames:
    """Frames of a frame set with their assignments before the update.

    Attributes:
        prediction: of all robots.
        tracked: (R,) robots whose detections were assigned.
        detections: of all frames.
        assignments: of the detections.
        observations: of the assignments, row by row, linearized about the prediction.
    """

    prediction: Prediction
    tracked: Mask
    detections: DetectionTable
    assignments: Assignments
    observations: LinearizedObservations

    def select(self, rows: Mask) -> "AssignedFrames":
        """The same with some of the assignments."""
        if rows.all():
            return self
        return replace(
            self, assignments=self.assignments.select(rows), observations=self.observations.select(rows)
        )


@dataclass(frozen=True, slots=True, eq=False)
class BodyFit:
    """Bodies after the observations of a frame set.

    Attributes:
        states: of all bodies; those without observations stay as predicted.
        squared_px: (N,) squared residuals, px^2; NaN where the disc is not visible.
        cost: (B,) of each fit: observations and prediction, robust; chi-square if all claims hold.
        equations: (N, 2, 13) of the centres, as they were linearized last; see `_core.FramePoses`.
        weights: (N,) of these.
    """

    states: States
    squared_px: Array
    cost: Array
    equations: Array
    weights: Array


class Estimator:
    """Predicts and updates bodies.

    Args:
        cameras: cameras of the rig.
        densities: (N, 2) of white angular and linear acceleration, rad^2/s^3 and m^2/s^3.
        single: (N,) bodies with a single marker.
    """

    def __init__(self, cameras: CameraArray, densities: Array, single: Mask) -> None:
        self.cameras = cameras
        self.densities = densities
        self.single = single

    def predict(self, states: States, dt: Array) -> Prediction:
        """Predict all bodies by `dt` (N,) seconds."""
        predicted, motion = predict(states, dt, self.densities, self.single)
        return Prediction(predicted, _core.inverses(predicted.P), motion)

    def update(
        self, prediction: Prediction, observations: MatchedObservations, small: float = SMALL
    ) -> tuple[States, Array]:
        """Fuse the observations of a frame set; bodies without observations stay as predicted.

        Args:
            prediction: the bodies before the update.
            observations: of this frame set.
            small: rad and m; a body with a larger correction is linearized again.

        Returns:
            the states, and the squared residuals (N,), px^2, NaN where the disc is not visible.
        """
        fitted = self.fit(prediction, self.prepared(prediction.states, observations), small)
        return fitted.states, fitted.squared_px

    def prepared(self, states: States, observations: MatchedObservations) -> LinearizedObservations:
        """Observations of predicted bodies with straight outlines, and the noise of late frames and of clocks."""
        return self.linearized(states, self.with_time_errors(states, self._straighten(states, observations)))

    def linearized(self, states: States, observations: MatchedObservations) -> LinearizedObservations:
        """Observations with the equations of their centres about predicted bodies."""
        seen, whiten = observations.detections, observations.whiten
        poses = self.cameras.frame_poses(states, seen.exposures)
        centres = poses.linearize_centres(observations.discs.columns, seen.xy, whiten, self.single)
        return LinearizedObservations(observations, centres)

    def fit(
        self, prediction: Prediction, linearized: LinearizedObservations, small: float = SMALL
    ) -> BodyFit:
        """`update` by `prepared` observations, linearized about the prediction."""
        observations = linearized.matched
        states, seen, discs = prediction.states, observations.detections, observations.discs
        if not len(observations):
            return BodyFit(states, np.empty(0), np.zeros(len(states)), np.empty((0, 2, 13)), np.empty(0))
        sigma = 2 * np.hypot(AXIS_SIGMA_PX, 2 * np.sqrt(seen.cov[0, 0])) / seen.axes_px[1]
        turned = read_headings(observations)
        with_headings, headings = observations.select(turned) if turned.any() else None, np.empty((0, 2, 13))
        fit = _core.BodyFit(
            states.bodies,
            self.cameras.exposed(seen.exposures),
            discs.columns,
            seen.xy,
            observations.whiten,
            self.single,
            seen.axes_px,
            seen.angle_rad,
            seen.scale,
            sigma,
            _shaped(observations),
            turned,
            linearized.centres,
            prediction.information,
        )
        for _ in range(MAX_ITERATIONS):
            if with_headings is not None:
                headings = linearize_headings(self.cameras, _estimates(fit, states.P), with_headings)
            if not fit.step(_eliminate(*fit.linearize(headings)), small):
                break
        R, (p, omega, v), P, equations, weights, squared_px, cost = fit.result(states.P, seen.cov)
        if self.single.any():
            P[self.single] = reset_unobservable(P[self.single])
        return BodyFit(States(R, p, omega, v, P), squared_px, cost, equations, weights)

    def with_time_errors(self, states: States, observations: MatchedObservations) -> MatchedObservations:
        """With the noise of late frames and of the clocks of the cameras."""
        return self._inflate_by_clock(states, self._inflate_late(states, observations))

    def innovations(self, states: States, observations: MatchedObservations) -> tuple[Array, Array]:
        """The whitened derivatives (2 N, 12) of N centres by the errors of their bodies, and innovations (2 N,)."""
        equations = self.linearized(states, observations).centres
        return equations[:, :, :12].reshape(-1, 12), equations[:, :, 12].ravel()

    def motion_px2(self, states: States, observations: MatchedObservations) -> Array:
        """(B,) mean square of a coordinate, px^2, by which the velocities of bodies displace their images between the
        exposures of a frame set: cameras that are off by as much look the same. NaN without observations."""
        body, tau, n = observations.discs.body, observations.detections.tau, len(states)
        velocity = self._image_velocity(states, observations, self._views(states, observations))
        moved = velocity * (tau - mean_by_body(tau, body, n)[body])
        return mean_by_body((moved**2).sum(0) / 2, body, n)

    def squared_px(self, states: States, observations: MatchedObservations) -> Array:
        """(N,) squared distances of the centres from those expected, px^2; NaN where the disc is not visible."""
        nu = self.innovations(states, observations)[1].reshape(-1, 2)
        return _core.squared_px(nu, observations.detections.cov, observations.whiten)

    def select(self, rows: NDArray) -> "Estimator":
        """The estimator of some of the bodies."""
        return Estimator(self.cameras, self.densities[rows], self.single[rows])

    def _views(self, states: States, observations: MatchedObservations) -> Views:
        return self.cameras.views(states, observations.detections.exposures, observations.discs)

    def _image_velocity(self, states: States, observations: MatchedObservations, now: Views) -> Array:
        """(2, N) velocities of the discs' images, pixels/s; 0 where the disc is not visible."""
        exposures = observations.detections.exposures
        later = replace(exposures, tau=exposures.tau + EXACT_S)
        moved = self.cameras.views(states, later, observations.discs).xy - now.xy
        return np.nan_to_num(np.einsum("ijn,jn->in", observations.detections.scale, moved) / EXACT_S)

    def _straighten(self, states: States, observations: MatchedObservations) -> MatchedObservations:
        """Undo the shear of the outlines of discs that moved while a rolling shutter read their rows.

        A row dv below the centre is read line_s dv later, when the image has moved by velocity line_s dv. At 500 px/s
        and a readout of 30 ms for 800 rows, that changes the outline's shape by 2 %.
        """
        seen = observations.detections
        line_s = seen.exposures.line_s[seen.frame]
        if not line_s.any():
            return observations
        B = np.tile(np.eye(2), (len(seen), 1, 1))
        velocity = self._image_velocity(states, observations, self._views(states, observations))
        B[:, :, 1] -= (velocity * line_s).T
        axes_px, angle_rad = _sheared(seen.axes_px, seen.angle_rad, B)
        return replace(observations, detections=seen.replaced(OUTLINE, np.vstack([axes_px, angle_rad])))

    def _inflate_late(self, states: States, observations: MatchedObservations) -> MatchedObservations:
        """Add to the noise of late detections the motion that the constant velocities do not predict.

        Velocities count as constant within `STEADY_S` of the frame set. Over a longer time tau, white acceleration of
        density q moves a marker with the variance q tau^3 / 3.
        """
        detections, discs = observations.detections, observations.discs
        tau = np.abs(detections.tau)
        if not (tau > STEADY_S).any():
            return observations
        late = np.maximum(tau - STEADY_S, 0)
        variance = self.densities[discs.body].T * late**3 / 3
        moved = _image_covariance(observations, self._views(states, observations), variance)
        return MatchedObservations.of_discs(detections.replaced(COV, detections.cov + moved), discs)

    def _inflate_by_clock(self, states: States, observations: MatchedObservations) -> MatchedObservations:
        """Add the motion during the standard deviation of the capture time: n sigma_t^2 (u u^T + C), u the image
        velocity and C its covariance: after an interruption velocities are hardly known.

        The n detections of a body in one frame have a common error, so that their mean has the variance sigma_t^2.
        """
        detections, discs = observations.detections, observations.discs
        exposures = detections.exposures
        if exposures.are_exact:
            return observations
        now = self._views(states, observations)
        velocity = self._image_velocity(states, observations, now)
        view = discs.frame * len(states) + discs.body
        sigma = exposures.tau_sigma[discs.frame] * np.sqrt(np.bincount(view)[view])
        P = np.diagonal(states.P, axis1=1, axis2=2)
        variance = np.stack([P[:, OMEGA].mean(1), P[:, VELOCITY].mean(1)])[:, discs.body]
        moved = velocity[:, None] * velocity + _image_covariance(observations, now, variance)
        cov = detections.cov + sigma**2 * moved
        return MatchedObservations.of_discs(detections.replaced(COV, cov), discs)


def _image_covariance(observations: MatchedObservations, views: Views, variance: Array) -> Array:
    """(2, 2, N) of discs whose bodies have errors of these variances (2, N), angular and linear."""
    scale, position = observations.detections.scale, observations.discs.position
    angular, linear = variance
    per_m = np.einsum("ian,jan->ijn", scale, scale) / views.centre[2] ** 2
    return per_m * (linear + angular * np.einsum("in,in->n", position, position))


def _sheared(axes_px: Array, angle_rad: Array, B: Array) -> tuple[Array, Array]:
    """Axes (2, N) and directions (N,) of ellipses after linear maps (N, 2, 2); unknown ones stay unknown."""
    known = np.flatnonzero(np.isfinite(axes_px).all(0) & np.isfinite(angle_rad))
    c, s = np.cos(angle_rad[known]), np.sin(angle_rad[known])
    root = B[known] @ (np.array([[c, -s], [s, c]]).transpose(2, 0, 1) * axes_px[:, None, known].T)
    values, vectors = np.linalg.eigh(root @ root.transpose(0, 2, 1))
    axes_px, angle_rad = axes_px.copy(), angle_rad.copy()
    axes_px[:, known] = np.sqrt(values[:, ::-1].T)
    angle_rad[known] = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
    return axes_px, angle_rad


def _estimates(fit: _core.BodyFit, P: Array) -> States:
    R, (p, omega, v) = fit.estimates()
    return States(R, p, omega, v, P)


def _eliminate(information: Array, right: Array) -> Array:
    """(K, 12) corrections of K bodies by one elimination; none of those whose systems are singular, as of a body that
    wrong detections moved next to a camera: it does not fit, and stays as predicted."""
    try:
        return _solve(information, right)
    except RuntimeError:
        if len(right) == 1:
            return np.zeros((1, 12))
    each = [slice(k, k + 1) for k in range(len(right))]
    return np.concatenate([_eliminate(information[k], right[k]) for k in each])


def _solve(information: Array, right: Array) -> Array:
    graph = gtsam.GaussianFactorGraph()
    for k, (H, g) in enumerate(zip(information, right, strict=True)):
        graph.push_back(gtsam.HessianFactor(k, H, g, 0.0))
    return graph.eliminateSequential(_ordering(len(right))).optimize().vector().reshape(-1, 12)


@lru_cache(maxsize=64)
def _ordering(n: int) -> gtsam.Ordering:
    """The keys 0 to n - 1."""
    ordering = gtsam.Ordering()
    for k in range(n):
        ordering.push_back(k)
    return ordering


def _shaped(observations: MatchedObservations) -> Mask:
    """(N,) known outlines of bodies with fewer than `MIN_SHAPED` visible markers."""
    discs = observations.discs
    body = np.full(np.max(discs.marker, initial=0) + 1, -1)
    body[discs.marker] = discs.body
    n_markers = np.bincount(body[body >= 0], minlength=1)
    return (n_markers[discs.body] < MIN_SHAPED) & np.isfinite(observations.detections.axes_px[1])
