# SPDX-License-Identifier: BSD-3-Clause
"""Recordings smoothed: each instant's poses by all instants, those after it too.

Rauch, Tung and Striebel (1965) on the tracker's own filter: backwards, with the gain C = P_k F^T (P_{k+1|k})^-1,

    x_k|N = x_k + C (x_{k+1|N} - x_{k+1|k}),   P_k|N = P_k + C (P_{k+1|N} - P_{k+1|k}) C^T.

A robot's row of instants begins anew where it was found, and ends where it was lost.
"""

from dataclasses import dataclass, replace

import msgspec
import numpy as np

from camera_node.arrays import Array, Mask
from camera_node.geometry.pose import vector_from_rotation, wxyz_from_rotation
from fusion.model.states import OMEGA, POSITION, THETA, VELOCITY, States
from fusion.tracking.estimator import Prediction
from fusion.tracking.result import Fused
from fusion.tracking.tracker import Tracker


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """An instant: what was told, the states after it, their prediction, and which robots that prediction is of."""

    fused: Fused
    states: States
    prediction: Prediction
    followed: Mask


class Smoother:
    """Remembers a tracker's instants; `smooth` gives them once more, in order, with smoothed poses."""

    def __init__(self, tracker: Tracker) -> None:
        self._tracker = tracker
        self._steps: list[_Step] = []

    def add(self, fused: Fused) -> None:
        """The tracker's last instant."""
        prediction, followed = self._tracker.predicted
        alive = np.array([status in ("tracked", "coasting") for status in self._tracker.status])
        self._steps.append(_Step(fused, self._tracker.states, prediction, followed & alive))

    def smooth(self) -> list[Fused]:
        """All instants; a covariance is then that of the smoothed pose."""
        if not self._steps:
            return []
        after = self._steps[-1].states
        smoothed = [after]
        for step, following in zip(self._steps[-2::-1], self._steps[:0:-1], strict=True):
            after = _smooth(step.states, following.prediction, after, following.followed)
            smoothed.append(after)
        return [
            self._told(step.fused, states) for step, states in zip(self._steps, smoothed[::-1], strict=True)
        ]

    def _told(self, fused: Fused, states: States) -> Fused:
        row = {name: k for k, name in enumerate(self._tracker.names)}
        wxyz = wxyz_from_rotation(states.R)
        poses = tuple(
            msgspec.structs.replace(
                pose,
                position=tuple(states.p[k].tolist()),
                quaternion_wxyz=tuple(wxyz[k].tolist()),
                velocity=tuple(states.v[k].tolist()),
                angular_velocity=tuple(states.omega[k].tolist()),
                covariance=states.P[k].astype("<f4").tobytes(),
            )
            for pose in fused.poses
            for k in (row[pose.robot],)
        )
        return replace(fused, poses=poses)


def _smooth(states: States, prediction: Prediction, after: States, followed: Mask) -> States:
    """The states of an instant, by those `after` it; robots that the prediction is not of stay as they are."""
    rows = np.flatnonzero(followed)
    if not len(rows):
        return states
    P, expected = states.P[rows], prediction.states.select(rows)
    C = np.linalg.solve(expected.P, prediction.motion.select(rows).carry(P)).transpose(0, 2, 1)
    error = _difference(after.select(rows), expected)
    better = states.select(rows).moved(np.einsum("nij,nj->ni", C, error))
    P = P + C @ (after.P[rows] - expected.P) @ C.transpose(0, 2, 1)
    return states.with_rows(rows, replace(better, P=(P + P.transpose(0, 2, 1)) / 2))


def _difference(a: States, b: States) -> Array:
    """(N, 12) the errors that bring b to a."""
    error = np.empty((len(a), 12))
    error[:, THETA] = vector_from_rotation(b.R.transpose(0, 2, 1) @ a.R)
    error[:, POSITION], error[:, OMEGA], error[:, VELOCITY] = a.p - b.p, a.omega - b.omega, a.v - b.v
    return error
