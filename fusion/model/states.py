# SPDX-License-Identifier: BSD-3-Clause
"""States of rigid bodies with covariance, and their motion model.

The error of a state is (delta theta, delta p, delta omega, delta v). The rotation is R exp(delta theta), in the body
frame; the other parts are added in the world frame. White noise on acceleration drives the motion (Bar-Shalom et al.
2001, section 6.2.2); see docs/design/fusion_filter.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera_node.foundation.arrays import Array, Mask
from camera_node.foundation.columns import Columns
from camera_node.geometry.pose import rotation_from_vector, vector_from_rotation
from fusion import _core

THETA, POSITION, OMEGA, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
UNKNOWN_ROTATION = np.pi**2  # variance of an unobservable rotation about the normal, rad^2
MAX_COAST_S = 30.0  # limit of the prediction interval, and so of the growth of the covariance
UNKNOWN_RATE = 10.0**2  # variance of an unobservable angular velocity, rad^2/s^2


@dataclass(frozen=True, slots=True, eq=False)
class States(Columns):
    """N bodies: R (N, 3, 3), p, omega and v (N, 3), all world frame; P (N, 12, 12)."""

    R: Array
    p: Array
    omega: Array
    v: Array
    P: Array

    @classmethod
    def at_rest(cls, R: Array, p: Array, sigmas: tuple[float, float, float, float]) -> "States":
        """Bodies at R, p with zero velocities, with these standard deviations of theta, p, omega and v."""
        n = len(p)
        P = np.tile(np.diag(np.repeat(np.square(sigmas), 3)), (n, 1, 1))
        return cls(R.copy(), p.copy(), np.zeros((n, 3)), np.zeros((n, 3)), P)

    @property
    def bodies(self) -> _core.BodyStates:
        """Poses and velocities for the native core."""
        return _core.BodyStates(self.R, self.p, self.omega, self.v)

    def with_rows(self, rows: NDArray, other: "States") -> "States":
        """A copy in which `other` replaces these rows."""
        copies = [getattr(self, name).copy() for name in self.__slots__]
        for copy, name in zip(copies, self.__slots__, strict=True):
            copy[rows] = getattr(other, name)
        return States(*copies)

    def minus(self, other: "States") -> Array:
        """(N, 12) the errors that displace `other` to these states, to first order."""
        rotation = vector_from_rotation(np.swapaxes(other.R, 1, 2) @ self.R)
        return np.hstack([rotation, self.p - other.p, self.omega - other.omega, self.v - other.v])

    def retract(self, delta: Array) -> "States":
        """The states displaced by errors (N, 12)."""
        return States(
            self.R @ rotation_from_vector(delta[:, THETA]),
            self.p + delta[:, POSITION],
            self.omega + delta[:, OMEGA],
            self.v + delta[:, VELOCITY],
            self.P,
        )


@dataclass(frozen=True, slots=True)
class FrameSetFit:
    """How robots fit the detections of a frame set.

    Attributes:
        is_doubtful: whether most robots contradict their predictions.
        displaced: cameras that show most markers elsewhere, and in how many frame sets in a row.
    """

    is_doubtful: bool
    displaced: Mapping[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """The robots at one time; `tracked` (R,) tells which of them detections determine, if the rig is right."""

    t_ns: int
    states: States
    tracked: Mask


@dataclass(frozen=True, slots=True, eq=False)
class Transition(Columns):
    """The transition matrices F of the errors of N bodies, by their off-diagonal blocks.

    Attributes:
        T: (N, 3, 3) derivative of the rotation by the angular velocity.
        dt: (N,) derivative of the position by the velocity, seconds.
    """

    T: Array
    dt: Array

    def multiply(self, errors: Array) -> Array:
        """F @ errors (N, 12, M)."""
        moved = errors.copy()
        moved[:, THETA] += self.T @ errors[:, OMEGA]
        moved[:, POSITION] += self.dt[:, None, None] * errors[:, VELOCITY]
        return moved


def predict(states: States, dt: Array, densities: Array, single: Mask) -> tuple[States, Transition]:
    """Predict bodies with constant velocities and white noise on acceleration.

    Args:
        states: N bodies.
        dt: (N,) seconds.
        densities: (N, 2) of white angular and linear acceleration, rad^2/s^3 and m^2/s^3.
        single: (N,) bodies with one marker: their normals follow random walks without an angular velocity.

    Returns:
        the predicted states with P = F P F^T + Q, `reset_unobservable` of single ones, and F.
    """
    R, p, P, T = _core.predict(states.bodies, states.P, dt, densities, single)
    if single.any():
        P[single] = reset_unobservable(P[single])
    return States(R, p, states.omega, states.v, P), Transition(T, dt)


def reset_unobservable(P: Array) -> Array:
    """Covariances (N, 12, 12) of single-marker bodies with unknown rotation about the normal and angular velocity."""
    P = P.copy()
    unknown = [2, 6, 7, 8]
    P[:, unknown, :] = 0
    P[:, :, unknown] = 0
    P[:, unknown, unknown] = [UNKNOWN_ROTATION, UNKNOWN_RATE, UNKNOWN_RATE, UNKNOWN_RATE]
    return P
