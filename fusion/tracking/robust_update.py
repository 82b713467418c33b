# SPDX-License-Identifier: BSD-3-Clause
"""Updates the states of robots with detections of which some may be wrong.

A robot that its detections contradict keeps its prediction. If the fits of most robots contradict their predictions,
the camera that causes this is left out of the frame set (`residual_monitor`). If none is found, the noise of all
detections grows until the fits agree with the predictions: robots hold to these, and claim less. Where many detections
of a robot contradict the others, the view of one camera is left out that explains this, as one in which markers were
taken for each other. Then detections are left out that contradict the others of their robot (joint compatibility).

At the start nothing has confirmed the rig, and the first fit of a robot explains what cameras contradict by a velocity.
Where this predicts most robots wrongly, they start again with noise.

Association gates each detection alone: the prediction may be off by a centimetre, and the gates are as wide. But that
error is common to all markers of a robot. Once some detections determine it, the others must lie within noise and
calibration errors (joint compatibility: Neira and Tardos 2001). The one that the others contradict most is removed
until all agree (Baarda's data snooping, 1968). A robust kernel alone may converge to a minimum at wrong detections,
since noise of 0.1 px makes all detections outliers of a prediction that is 1 px off.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from camera_node.foundation.arrays import Array, Index, Mask
from fusion import _core
from fusion.model.observations import (
    Assignments,
    LinearizedObservations,
    MarkerTable,
    MatchedObservations,
    count_checked,
    mean_by_body,
    views,
)
from fusion.model.states import POSITION, VELOCITY, States
from fusion.monitoring.residual_monitor import FALSE_ALARM, LEARNED, ResidualMonitor, camera_at_fault
from fusion.tracking.estimator import AssignedFrames, Estimator, Prediction
from fusion.tracking.gating import MAX_CHI2
from fusion.tracking.labelings import are_unchecked
from fusion.tracking.rays import GATE

# Squared residual over that of calibration errors, from which a robot's detections are compared.
SUSPICIOUS = 4.0
# Correction of a position in standard deviations of its prediction: those of frames 33 ms apart have 11 mm. No false
# roundel has displaced a robot by more than its correction and the error of its prediction.
MIN_CORRECTION = 0.5
MAX_ADDED_PX2 = 32.0**2  # noise that makes anything usual within the gates of association
CONTRADICTED = 0.5  # share of a robot's detections with a large misfit, above which none of them is its own
A_VIEW = 0.25  # the same, from which the view of a camera may be wrong: most robots are seen by four or fewer


@dataclass(frozen=True, slots=True, eq=False)
class RobustFit:
    """An update: the states, and the assignments that fit, with residuals.

    Attributes:
        given: the robots before the update, and the assignments that were fitted, also those that do not fit.
        needed: (R,) see `TrackTable.needed_detections`.
        observations, equations, weights: of the assignments, row by row, with the noise that the fit gives them; see
            `BodyFit`.
        cost, count: (R,) of each robot: its fit, as of `BodyFit`, and its detections.
        contradicting: (R,) share of these with a large misfit.
        added_px2: variance that the fit gave the detections beside their own noise.
    """

    states: States
    assignments: Assignments
    given: AssignedFrames
    needed: Index
    observations: LinearizedObservations
    equations: Array
    weights: Array
    cost: Array
    count: Index
    contradicting: Array
    added_px2: float

    @property
    def prediction(self) -> Prediction:
        """The robots before the update."""
        return self.given.prediction

    def without(self, contradicted: Mask) -> "RobustFit":
        """Robots (R,) that their detections contradict stay as predicted and lose them."""
        rows, kept = np.flatnonzero(contradicted), ~contradicted[self.observations.body]
        return replace(
            self,
            states=self.states.with_rows(rows, self.prediction.states.select(rows)),
            assignments=self.assignments.select(kept),
            observations=self.observations.select(kept),
            equations=self.equations[kept],
            weights=self.weights[kept],
        )


class RobustUpdate:
    """Updates robots, and learns which residuals are usual.

    Args:
        estimator: of the robots.
        markers: of the robots.

    Attributes:
        added_px2: variance that detections have beside their own noise while nothing explains what they contradict.
        is_confirmed: whether frame sets were usual since the start, so that the rig holds.
    """

    def __init__(self, estimator: Estimator, markers: MarkerTable) -> None:
        self._estimator, self._markers = estimator, markers
        self._residuals = ResidualMonitor()
        self._left_out: int | None = None  # the camera at fault in the last frame set
        self.is_confirmed = False
        self.added_px2 = 0.0

    def inherit(self, old: "RobustUpdate") -> None:
        """Continue with the usual residuals of other robots."""
        self._residuals, self.is_confirmed = old._residuals, old.is_confirmed

    @property
    def noise_px2(self) -> float:
        """Variance that detections have beside their own noise, by usual errors of the cameras and unexplained ones."""
        return self._residuals.slack_px**2 + self.added_px2

    @property
    def is_doubtful(self) -> bool:
        """Whether the last frame set contradicted the predictions."""
        return self._left_out is not None or self.added_px2 > 0

    def start(self, motion_px2: Array, n_predicted: int) -> None:
        """Robots start before the rig is confirmed. Their detections have the variance beside their own noise that
        velocities explain of the median robot: cameras that are off by as much look the same.

        Args:
            motion_px2: as of `Estimator.motion_px2`, of those that were acquired before, and not where they are now.
            n_predicted: robots that are where they were predicted.
        """
        if len(motion_px2):
            median_px2 = np.median(np.concatenate([motion_px2, np.zeros(n_predicted)]))
            self.added_px2 = max(self.added_px2, float(median_px2))

    def refuted(self, fitted: RobustFit, tracked: Mask) -> Mask:
        """(R,) tracked robots that are not where their velocities predicted, if these are most, before anything has
        confirmed the rig: the frame set in which they started shows errors of cameras as velocities."""
        if self.is_confirmed or self.added_px2:
            return np.zeros_like(tracked)
        before, v = fitted.prediction.states, fitted.states.v - fitted.prediction.states.v
        gained = np.linalg.solve(before.P[:, VELOCITY, VELOCITY], v[:, :, None])[:, :, 0]
        differs = np.einsum("ni,ni->n", v, gained) > chdtri(3, FALSE_ALARM)
        cameras = fitted.given.detections.exposures.camera  # without frames of all, robots may only be unseen
        is_whole = len(np.unique(cameras)) == len(self._estimator.cameras.names)
        refuted = tracked & (differs | ((fitted.count == 0) & is_whole))
        return refuted & (2 * refuted.sum() > tracked.sum())

    def settle(self) -> None:
        """The rig graph judged what the detections contradict: what is usual from now on is learnt."""
        self._residuals, self._left_out, self.added_px2 = ResidualMonitor(), None, 0.0

    def update(self, given: AssignedFrames, needed: Index, is_sudden: bool) -> RobustFit:
        """The updated states, and the assignments that fit; `needed` as of `RobustFit`, `is_sudden` as of
        `MotionModels`: then a camera that explains it alone has moved, and the robots have not."""
        fitted = self._fit(given, needed)
        if self.added_px2:
            self.added_px2 *= 0.5 ** (1 / LEARNED) if self.added_px2 > self._least_px2(fitted) else 0.0
        self.is_confirmed |= self._residuals.is_known
        if self.added_px2 and not self.is_confirmed:
            self.added_px2 = max(self.added_px2, self._contradiction_px2(fitted))
        is_unusual = self._is_unusual(fitted)
        if (again := self._left_out_again(fitted)) is not None:
            fitted = again
        elif (is_unusual or is_sudden) and (without := self._leave_one_out(fitted)) is not None:
            fitted = without
        elif is_unusual:
            fitted = self._with_noise(fitted)
        else:
            self._left_out = None
            if self.added_px2:
                fitted = self._fit(fitted.given, needed, self.added_px2)
            else:
                self._residuals.learn(fitted.assignments.squared_px, fitted.cost, fitted.count)
        return self._without_incompatible(self._without_wrong_views(fitted))

    @staticmethod
    def _least_px2(fitted: RobustFit) -> float:
        """Less noise than detections have themselves changes nothing."""
        detections = fitted.given.detections
        return float(detections.variance_px2.mean()) if len(detections) else 0.0

    def _contradiction_px2(self, fitted: RobustFit) -> float:
        """What velocities explain that the predictions do not have, of the median robot that two cameras see."""
        before, after, of = fitted.prediction.states, fitted.states, fitted.observations.matched
        seen = np.flatnonzero(count_checked(of.discs.body, of.detections.camera, len(after)))
        if not len(seen):
            return 0.0
        states = replace(after, omega=after.omega - before.omega, v=after.v - before.v)
        return float(np.median(self._estimator.motion_px2(states, of)[seen]))

    def _is_unusual(self, fitted: RobustFit) -> bool:
        return self._residuals.is_unusual(fitted.cost, fitted.count)

    def _fit(self, given: AssignedFrames, needed: Index, added_px2: float = 0.0) -> RobustFit:
        """The updated states; a robot that its detections contradict stays as predicted and loses them, as does one
        whose prediction does not check them, if they contradict each other or are too few."""
        prediction, observations = given.prediction, given.observations
        if added_px2:
            noisy = observations.matched.with_noise(added_px2)
            observations = self._estimator.linearized(prediction.states, noisy)
        fitted = self._estimator.fit(prediction, observations)
        body, n = observations.body, len(prediction.states)
        is_large = observations.matched.misfit(fitted.squared_px) > MAX_CHI2
        share = mean_by_body(is_large, body, n)
        contradicted = share > np.where(needed, 0.0, CONTRADICTED)
        contradicted |= are_unchecked(needed, body, observations.camera)
        fit = RobustFit(
            states=fitted.states,
            assignments=given.assignments.with_residuals(fitted.squared_px),
            given=given,
            needed=needed,
            observations=observations,
            equations=fitted.equations,
            weights=fitted.weights,
            cost=fitted.cost,
            count=np.bincount(body, minlength=n),
            contradicting=share,
            added_px2=added_px2,
        )
        return fit.without(contradicted) if contradicted.any() else fit

    def _without(self, k: int, fitted: RobustFit) -> RobustFit:
        given = fitted.given
        return self._fit(given.select(given.observations.camera != k), fitted.needed)

    def _left_out_again(self, fitted: RobustFit) -> RobustFit | None:
        """The fit without the camera that was left out before, while that one does not agree with it."""
        if self._left_out is None:
            return None
        again = self._without(self._left_out, fitted)
        cost, count = float((fitted.cost - again.cost).sum()), int((fitted.count - again.count).sum())
        return None if self._is_unusual(again) or self._residuals.is_explained(cost, count) else again

    def _leave_one_out(self, fitted: RobustFit) -> RobustFit | None:
        """The fit without the camera that contradicts predictions and all others, if there is one."""
        camera = fitted.given.observations.camera
        fits = {k: self._without(k, fitted) for k in np.unique(camera).tolist()}
        costs = {k: float(fit.cost.sum()) for k, fit in fits.items()}
        self._left_out = camera_at_fault(float(fitted.cost.sum()), costs)
        return (
            None if self._left_out is None or self._is_unusual(fits[self._left_out]) else fits[self._left_out]
        )

    def _with_noise(self, fitted: RobustFit) -> RobustFit:
        """The fit with as much noise as makes it usual, no less than the frame set before had."""
        self.added_px2 = max(self.added_px2, self._least_px2(fitted))
        while self._is_unusual(again := self._fit(fitted.given, fitted.needed, self.added_px2)):
            self.added_px2 *= 2
            if self.added_px2 > MAX_ADDED_PX2:
                break
        return again

    def _without_wrong_views(self, fitted: RobustFit) -> RobustFit:
        """The fit without the views that explain why many detections of a robot contradict the others, if one camera
        does, far better than any other. Where those of most robots do, the rig has errors that it does not state."""
        doubtful = np.flatnonzero(fitted.contradicting >= A_VIEW)
        if not len(doubtful) or np.median(fitted.contradicting[fitted.count > 0]) > 0:
            return fitted
        given = fitted.given
        robot, camera = given.observations.body, given.observations.camera
        seen = views(robot, camera, len(fitted.contradicting))
        is_doubtful, wrong = np.isin(robot, doubtful), np.zeros_like(seen)
        costs = {
            k: self._fit(given.select(is_doubtful & (camera != k)), fitted.needed, fitted.added_px2).cost
            for k in np.flatnonzero(seen[doubtful].any(0)).tolist()
        }
        for row in doubtful.tolist():
            without = {k: float(costs[k][row]) for k in np.flatnonzero(seen[row]).tolist()}
            k = camera_at_fault(float(fitted.cost[row]), without)
            if k is not None:
                wrong[row, k] = True
        if not wrong.any():
            return fitted
        return self._fit(given.select(~wrong[robot, camera]), fitted.needed, fitted.added_px2)

    def _without_incompatible(self, fitted: RobustFit) -> RobustFit:
        """The fit to detections that do not contradict the others of their robots; all keep their residuals.

        A robot whose compatible detections fit already stays as it is: the others have hardly any weight.
        """
        slack_px2 = self._residuals.slack_px**2, fitted.added_px2
        detections, robot = fitted.given.detections, self._markers.robot[fitted.assignments.marker]
        suspicious = fitted.assignments.squared_px > SUSPICIOUS * sum(slack_px2)
        if not suspicious.any():
            return fitted
        rows = np.flatnonzero(self._may_be_displaced(fitted, robot[suspicious])[robot])
        if not len(rows):
            return fitted
        observations = MatchedObservations.of(fitted.assignments.select(rows), detections, self._markers)
        compatible = jointly_compatible(self._estimator, fitted.prediction, observations, *slack_px2)
        displaced = np.intersect1d(robot[rows[~compatible]], robot[rows[compatible & suspicious[rows]]])
        if not len(displaced):
            return fitted
        again = np.isin(robot[rows], displaced)
        used = rows[again & compatible]
        fit = self._estimator.fit(fitted.prediction, fitted.observations.select(used))
        equations, weights = fitted.equations.copy(), fitted.weights.copy()
        weights[rows[again]] = 0.0
        equations[used], weights[used] = fit.equations, fit.weights
        states = fitted.states.with_rows(displaced, fit.states.select(displaced))
        squared_px = fitted.assignments.squared_px.copy()
        squared_px[rows[again]] = self._estimator.squared_px(states, observations.select(again))
        assignments = replace(fitted.assignments, squared_px=squared_px)
        return replace(fitted, states=states, assignments=assignments, equations=equations, weights=weights)

    def _may_be_displaced(self, fitted: RobustFit, robots: Index) -> Mask:
        """(R,) the given ones of all robots that the update moved from their predictions."""
        states = fitted.prediction.states
        moved = np.zeros(len(states), bool)
        moved[robots] = True
        variance = np.einsum("nii->n", states.P[:, POSITION, POSITION]) / 3
        return moved & (np.sum((fitted.states.p - states.p) ** 2, 1) > MIN_CORRECTION**2 * variance)


def jointly_compatible(
    estimator: Estimator,
    prediction: Prediction,
    observations: MatchedObservations,
    slack_px2: float,
    common_px2: float,
) -> Mask:
    """(N,) the observations that agree with the prediction and the other ones of their bodies.

    Args:
        estimator: of the bodies.
        prediction: of the bodies.
        observations: N of them, which the prediction shows.
        slack_px2: variance of calibration errors beside the noise.
        common_px2: variance of an error that all detections of a camera share, as by its turn.
    """
    observations = estimator.with_time_errors(prediction.states, observations)
    A, nu = estimator.innovations(prediction.states, observations)
    variance = observations.detections.variance_px2
    share = np.sqrt(variance / (variance + slack_px2))[:, None]
    A, nu = A.reshape(-1, 2, 12) * share[:, :, None], nu.reshape(-1, 2) * share
    if common_px2:
        cameras, seen_by = np.unique(observations.detections.camera, return_inverse=True)
        turns = np.eye(2 * len(cameras)).reshape(-1, 2, 2 * len(cameras))[seen_by]
        A = np.concatenate([A, turns * np.sqrt(common_px2 / (variance + slack_px2))[:, None, None]], 2)
    n = A.shape[2]
    order = np.argsort(observations.discs.body, kind="stable")
    bodies, first, count = np.unique(observations.discs.body[order], return_index=True, return_counts=True)
    row = np.repeat(np.arange(len(bodies)), count)
    at = row, np.arange(len(order)) - first[row]
    tables = np.zeros((len(bodies), int(count.max()), 2, n)), np.zeros((len(bodies), int(count.max()), 2))
    tables[0][at], tables[1][at] = A[order], nu[order]
    compatible = np.ones(len(nu), bool)
    information = np.tile(np.eye(n), (len(bodies), 1, 1))
    information[:, :12, :12] = prediction.information[bodies]
    compatible[order] = _compatible(*tables, information)[at]
    return compatible


def _compatible(A: Array, nu: Array, information: Array) -> Mask:
    """(B, N) of B bodies: whitened derivatives A (B, N, 2, E), innovations nu (B, N, 2) and prior information.

    Rows of zeros, which fill the table, are compatible.
    """
    used, bodies = np.ones(nu.shape[:2], bool), np.arange(len(nu))
    while len(bodies):
        rows = used[bodies][:, :, None]
        deviation = _deviations(A[bodies] * rows[..., None], nu[bodies] * rows, information[bodies])
        worst = np.argmax(deviation, 1)
        found = deviation[np.arange(len(bodies)), worst] > GATE
        bodies, worst = bodies[found], worst[found]
        used[bodies, worst] = False
    return used


def _deviations(A: Array, nu: Array, information: Array) -> Array:
    """(B, N) squared deviations of each observation from the prediction and all others; 0 for rows of zeros."""
    J, shape = A.reshape(len(A), -1, A.shape[-1]), nu.shape
    inverses = np.linalg.inv if A.shape[-1] > 12 else _core.inverses
    CJ = J @ inverses(information + J.transpose(0, 2, 1) @ J)
    solution = J.transpose(0, 2, 1) @ nu.reshape(len(A), -1, 1)
    u, v = np.moveaxis(nu - (CJ @ solution).reshape(shape), 2, 0)
    (Bu, Bv), (Au, Av) = np.moveaxis(CJ.reshape(A.shape), 2, 0), np.moveaxis(A, 2, 0)
    S_uu, S_vv, S_uv = 1 - (Bu * Au).sum(2), 1 - (Bv * Av).sum(2), -(Bu * Av).sum(2)  # of the residuals
    return (S_vv * u * u - 2 * S_uv * u * v + S_uu * v * v) / (S_uu * S_vv - S_uv**2)
