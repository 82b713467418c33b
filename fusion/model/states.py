# SPDX-License-Identifier: BSD-3-Clause
"""Where robots are and how they move: a batch of rigid bodies with covariance, and their motion model.

The error of a state is (delta theta, delta p, delta omega, delta v): R exp(delta theta) in the body's frame, the rest
added in the world. White noise on acceleration (Bar-Shalom et al. 2001, section 6.2.2) drives it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera_node.arrays import Array, Mask
from camera_node.geometry.pose import rotation_from_vector
from fusion import _core

THETA, POSITION, OMEGA, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
UNKNOWN_TURN = np.pi**2  # variance of a turn about the normal that nothing tells, rad^2
UNKNOWN_RATE = 10.0**2  # variance of a turning rate that nothing tells, rad^2/s^2


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """N bodies: R (N, 3, 3) and p (N, 3) in the world, omega and v (N, 3) in the world, P (N, 12, 12)."""

    R: Array
    p: Array
    omega: Array
    v: Array
    P: Array

    @classmethod
    def at_rest(cls, R: Array, p: Array, sigmas: tuple[float, float, float, float]) -> "States":
        """Bodies at R, p and without motion, to the standard deviations of theta, p, omega and v."""
        n = len(p)
        P = np.tile(np.diag(np.repeat(np.square(sigmas), 3)), (n, 1, 1))
        return cls(R.copy(), p.copy(), np.zeros((n, 3)), np.zeros((n, 3)), P)

    def __len__(self) -> int:
        return len(self.p)

    def select(self, rows: NDArray) -> "States":
        """The rows that a mask or an index array names."""
        return States(self.R[rows], self.p[rows], self.omega[rows], self.v[rows], self.P[rows])

    def with_rows(self, rows: NDArray, other: "States") -> "States":
        """A copy in which `other` stands in these rows."""
        copies = [getattr(self, name).copy() for name in self.__slots__]
        for copy, name in zip(copies, self.__slots__, strict=True):
            copy[rows] = getattr(other, name)
        return States(*copies)

    def moved(self, delta: Array) -> "States":
        """The states displaced by errors (N, 12)."""
        return States(
            self.R @ rotation_from_vector(delta[:, THETA]),
            self.p + delta[:, POSITION],
            self.omega + delta[:, OMEGA],
            self.v + delta[:, VELOCITY],
            self.P,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Transition:
    """How errors of N bodies move in `dt` (N,) seconds: F adds `turn` (N, 3, 3) of the rate's, dt of the speed's."""

    turn: Array
    dt: Array

    def carry(self, errors: Array) -> Array:
        """F @ errors (N, 12, M)."""
        moved = errors.copy()
        moved[:, THETA] += self.turn @ errors[:, OMEGA]
        moved[:, POSITION] += self.dt[:, None, None] * errors[:, VELOCITY]
        return moved

    def select(self, rows: NDArray) -> "Transition":
        """The rows that a mask or an index array names."""
        return Transition(self.turn[rows], self.dt[rows])


def predict(states: States, dt: Array, densities: Array, single: Mask) -> tuple[States, Transition]:
    """Where bodies are after `dt` (N,) seconds.

    Args:
        states: N bodies.
        dt: seconds each.
        densities: (N, 2) of white angular and linear acceleration, rad^2/s^3 and m^2/s^3.
        single: (N,) bodies of one marker: their normal wanders, and no turning rate is claimed.

    Returns:
        the predicted states, P = F P F^T + Q; how an error moves.
    """
    of_each = states.R, states.p, states.omega, states.v, states.P
    R, p, P, turn = _core.predict(*of_each, dt, densities, single)
    return States(R, p, states.omega, states.v, P), Transition(turn, dt)


def forget_turn(P: Array) -> Array:
    """Covariances (N, 12, 12) of one-marker bodies, their turn about the normal and turning rate unknown again."""
    P = P.copy()
    unknown = [2, 6, 7, 8]
    P[:, unknown, :] = 0
    P[:, :, unknown] = 0
    P[:, unknown, unknown] = [UNKNOWN_TURN, UNKNOWN_RATE, UNKNOWN_RATE, UNKNOWN_RATE]
    return P
