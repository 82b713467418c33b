# SPDX-License-Identifier: BSD-3-Clause
"""Smooths recordings: estimates the poses of each frame set from all frame sets, including later ones.

Rauch, Tung and Striebel (1965) on the steps of the filter: backwards, with the gain C = P_k F^T (P_{k+1|k})^-1,

    x_k|N = x_k + C (x_{k+1|N} - x_{k+1|k}),   P_k|N = P_k + C (P_{k+1|N} - P_{k+1|k}) C^T.

The smoothed track of a robot starts where the robot was acquired and ends where it was lost. The gains of successive
steps are multiplied, so what later frame sets change decays, and a recording of any length is smoothed in parts.
"""

from dataclasses import replace
from itertools import pairwise

import msgspec
import numpy as np

from camera_node.foundation.arrays import Array, Mask
from camera_node.geometry.pose import vector_from_rotation, wxyz_from_rotation
from fusion.model.states import OMEGA, POSITION, THETA, VELOCITY, States
from fusion.protocol.pose_messages import covariance_bytes
from fusion.tracking.estimator import Prediction
from fusion.tracking.result import TrackingResult

# What frame sets later than this change is below a thousandth of a standard deviation, as a test shows; three times as
# long as a robot without observations is not lost.
LAG_NS = 1_000_000_000


class Smoother:
    """Smooths tracking results, which are given in order.

    Args:
        names: of the robots, in the order of the states.
        lag_ns: how much later frame sets change a result, at least; twice as much is held in memory.
    """

    def __init__(self, names: tuple[str, ...], lag_ns: int = LAG_NS) -> None:
        self._lag_ns = lag_ns
        self._row = {name: k for k, name in enumerate(names)}
        self._results: list[TrackingResult] = []

    def add(self, result: TrackingResult) -> list[TrackingResult]:
        """Add the next result; those that are `lag_ns` older, smoothed with their covariances, once in a while."""
        self._results.append(result)
        if result.t_ns - self._results[0].t_ns < 2 * self._lag_ns:
            return []
        smoothed = self._smooth(sum(r.t_ns <= result.t_ns - self._lag_ns for r in self._results))
        del self._results[: len(smoothed)]
        return smoothed

    def finish(self) -> list[TrackingResult]:
        """The remaining results."""
        smoothed, self._results = self._smooth(len(self._results)), []
        return smoothed

    def _smooth(self, n: int) -> list[TrackingResult]:
        """The first n results, smoothed by all."""
        smoothed = [result.step.states for result in self._results]
        for k, (result, following) in reversed(list(enumerate(pairwise(self._results)))):
            step = following.step
            smoothed[k] = _smooth(result.step.states, step.prediction, smoothed[k + 1], step.continued)
        return [self._with_states(*both) for both in zip(self._results[:n], smoothed[:n], strict=True)]

    def _with_states(self, result: TrackingResult, states: States) -> TrackingResult:
        wxyz, P = wxyz_from_rotation(states.R), states.P + result.step.rig
        poses = tuple(
            msgspec.structs.replace(
                pose,
                position=tuple(states.p[k].tolist()),
                quaternion_wxyz=tuple(wxyz[k].tolist()),
                velocity=tuple(states.v[k].tolist()),
                angular_velocity=tuple(states.omega[k].tolist()),
                covariance=covariance_bytes(P[k]),
            )
            for pose in result.poses
            for k in (self._row[pose.robot],)
        )
        return replace(result, poses=poses)


def _smooth(states: States, prediction: Prediction, after: States, continued: Mask) -> States:
    """Smooth `states` with the smoothed states `after` them; robots outside `continued` do not change."""
    rows = np.flatnonzero(continued)
    if not len(rows):
        return states
    P, expected = states.P[rows], prediction.states.select(rows)
    C = np.linalg.solve(expected.P, prediction.motion.select(rows).multiply(P)).transpose(0, 2, 1)
    error = _difference(after.select(rows), expected)
    better = states.select(rows).retract(np.einsum("nij,nj->ni", C, error))
    P = P + C @ (after.P[rows] - expected.P) @ C.transpose(0, 2, 1)
    return states.with_rows(rows, replace(better, P=(P + P.transpose(0, 2, 1)) / 2))


def _difference(a: States, b: States) -> Array:
    """(N, 12) errors whose retraction of b is a."""
    error = np.empty((len(a), 12))
    error[:, THETA] = vector_from_rotation(b.R.transpose(0, 2, 1) @ a.R)
    error[:, POSITION], error[:, OMEGA], error[:, VELOCITY] = a.p - b.p, a.omega - b.omega, a.v - b.v
    return error
