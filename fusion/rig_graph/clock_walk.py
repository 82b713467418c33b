# SPDX-License-Identifier: BSD-3-Clause
"""The clocks of the cameras as random walks: offsets and rates, from windows of keyframes (a Kalman filter).

A window shows the differences between the offsets; a common one of all cameras moves robots along their paths. So the
camera at fault is the one that alone explains the estimate, by a margin over every other one: a generalized likelihood
ratio, as in `hypotheses`. docs/design/time_offsets.md has the equations.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from camera_node.foundation.arrays import Array
from fusion.rig_graph.hypotheses import FALSE_ALARM

OFFSET_SIGMA_S = 5e-4  # of a calibrated clock
RATE_SIGMA = 1e-3  # of a clock against others, if it is not disciplined: crystals have 1e-4, bad drivers more
RATE_WALK = 1e-5  # change of a rate in a second, which a clock that begins to drift needs
BIAS_SIGMA_S = (
    2e-3  # of what windows show of an offset, the same in all: errors of velocities, lenses and shapes
)
MAX_OFFSET_S = 1.0  # standard deviation beyond which nothing is known
RIVAL = 1e-3  # likelihood of another camera at fault, relative to the accepted one


@dataclass(frozen=True, slots=True)
class Departure:
    """A camera whose true capture times are later than its stamps by offset_s + rate (t - t_ns), sigma_s at t_ns."""

    camera: int
    t_ns: int
    offset_s: float
    rate: float
    sigma_s: float

    def at(self, t_ns: int) -> float:
        """The offset at a time, s."""
        return self.offset_s + self.rate * (t_ns - self.t_ns) * 1e-9


class ClockWalk:
    """Offsets and rates of C clocks from their corrected stamps.

    Args:
        n_cameras: C.

    Attributes:
        x, P: (3 C,) offset (s) and rate of each camera, then the bias of each offset, and their covariance.
    """

    def __init__(self, n_cameras: int) -> None:
        self._n, self._t_ns = n_cameras, 0
        self.x, self.P = np.zeros(0), np.zeros((0, 0))
        self._restart()

    def _restart(self) -> None:
        n, self.x = self._n, np.zeros(3 * self._n)
        self.P = np.diag([*np.tile([OFFSET_SIGMA_S**2, RATE_SIGMA**2], n), *np.full(n, BIAS_SIGMA_S**2)])

    def jump(self, camera: int, sigma_s: float) -> None:
        """The stamps of a camera were corrected by a jump with this standard deviation, or may have jumped so far."""
        self.P[2 * camera, 2 * camera] += sigma_s**2

    def update(self, t_ns: int, M: Array, y: Array) -> None:
        """Add a window: least squares M x = y (C, C) and (C,) about the offsets at its middle."""
        self._predict(max(0, t_ns - (self._t_ns or t_ns)) * 1e-9)
        self._t_ns = t_ns
        information = np.linalg.inv(self.P)
        right = information @ self.x
        shown = np.zeros((self._n, 3 * self._n))
        shown[:, : 2 * self._n : 2] = shown[:, 2 * self._n :] = np.eye(self._n)
        information += shown.T @ M @ shown
        right += shown.T @ y
        self.P = np.linalg.inv(information)
        self.x = self.P @ right

    def _predict(self, dt: float) -> None:
        F, noise = np.eye(3 * self._n), np.zeros((3 * self._n, 3 * self._n))
        F[: 2 * self._n, : 2 * self._n] = np.kron(np.eye(self._n), [[1.0, dt], [0.0, 1.0]])
        Q = RATE_WALK**2 * dt * np.array([[dt**2 / 3, dt / 2], [dt / 2, 1.0]])
        noise[: 2 * self._n, : 2 * self._n] = np.kron(np.eye(self._n), Q)
        self.x, self.P = F @ self.x, F @ self.P @ F.T + noise
        if np.diag(self.P).max() > MAX_OFFSET_S**2:
            self._restart()

    def take_departure(self) -> Departure | None:
        """The camera at fault, whose stamps are corrected from now on; None if none is, or the windows do not decide.

        Its clock may depart as much again: the prior of a good clock does not hold for it.
        """
        M = np.linalg.inv(self.P[: 2 * self._n, : 2 * self._n])
        own = np.arange(2 * self._n).reshape(-1, 2)
        y, blocks = (M @ self.x[: 2 * self._n])[own], np.linalg.inv(M[own[:, :, None], own[:, None]])
        alone = np.einsum("kij,kj->ki", blocks, y)
        explained = np.sum(y * alone, 1)
        k = int(np.argmax(explained))
        rival = np.max(np.delete(explained, k), initial=0.0)
        if explained[k] < chdtri(2, FALSE_ALARM) or explained[k] - rival < chdtri(2, RIVAL):
            return None
        self.x[own[k]] -= alone[k]
        self.P[own[k], own[k]] += alone[k] ** 2
        offset_s, rate = alone[k].tolist()
        return Departure(k, self._t_ns, offset_s, rate, float(np.sqrt(blocks[k, 0, 0])))
