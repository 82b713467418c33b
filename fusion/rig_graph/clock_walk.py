# SPDX-License-Identifier: BSD-3-Clause
"""The clocks of the cameras as random walks: offsets and rates, from the keyframes of the rig graph (a Kalman filter).

The errors of the cameras' poses and lenses are states of the same filter, so that they do not look like offsets. A
common offset of all cameras moves robots along their paths. So the camera at fault is the one that alone explains the
estimate, by a margin over every other one: a generalized likelihood ratio, as in `hypotheses`.
docs/design/time_offsets.md has the equations.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from calib.rig.camera_errors import ERRORS
from camera_node.foundation.arrays import Array, Index
from fusion.rig_graph.hypotheses import CAUSES, FALSE_ALARM, FREE_SIGMA, INTERVAL_NS, RIVAL, explained

OFFSET_SIGMA_S = 5e-4  # of a calibrated clock
RATE_SIGMA = 1e-3  # of a clock against others, if it is not disciplined: crystals have 1e-4, bad drivers more
# Of an offset, s, and a rate that changed: cameras have stated rates that are 1 % wrong.
CHANGED_SIGMA = 0.1, 1e-2
RATE_WALK = 1e-4  # change of a rate in a second: a daemon that slews a clock changes it by 5e-4 at once
MAX_PENDING = 60  # rates of a clock by arrivals that wait for keyframes: one a second, for a minute
MEMORY_S = 10.0  # of errors of poses and lenses: what they do to offsets varies with the places of robots


@dataclass(frozen=True, slots=True)
class Departure:
    """A camera whose true capture times are later than its stamps by offset_s + rate (t - t_ns), with their sigmas."""

    camera: int
    t_ns: int
    offset_s: float
    rate: float
    sigma_s: float
    rate_sigma: float

    def at(self, t_ns: int) -> float:
        """The offset at a time, s."""
        return self.offset_s + self.rate * (t_ns - self.t_ns) * 1e-9


def other_offsets(P: Array, H: Array, y: Array) -> tuple[Array, Array]:
    """(C,) how much less keyframes cost if the clock of one camera alone has any other offset, and (C,) that offset, s;
    see `explained`."""
    return explained(P, H, y, np.eye(len(y))[:, CAUSES["clock"].start :: ERRORS], CHANGED_SIGMA[0])


class ClockWalk:
    """Offsets and rates of C clocks from their corrected stamps.

    Args:
        n_cameras: C.

    Attributes:
        x, P: (9 C,) the errors of the cameras, 8 of each, and then the rates of their clocks; and their covariance.
        offsets, rates: (C,) rows of these.
        departed: cameras whose clocks jumped or drifted, oldest first: they are not held to be right until they are
            known again, as well as a good clock. Else the last one would be the reference for ever, whatever it did.
        is_suspicious: whether a clock may have departed, which the next keyframes decide.
    """

    def __init__(self, n_cameras: int) -> None:
        self._n, self.departed = n_cameras, list[int]()
        self._t_ns = self._shown_ns = 0  # of the estimate, and of the last keyframes
        # Of rates by arrivals that were not used yet: time, camera, rate and standard deviation.
        self._pending = deque[tuple[int, int, float, float]](maxlen=MAX_PENDING * n_cameras)
        self.is_suspicious = False
        self._drift = np.zeros(n_cameras)  # rates that explain what the last keyframes show of the offsets
        self.rates = ERRORS * n_cameras + np.arange(n_cameras)
        self.offsets = ERRORS * np.arange(n_cameras) + CAUSES["clock"].start
        self.x = np.zeros((ERRORS + 1) * n_cameras)
        self._corrected: set[int] = set()  # the cameras that have departed so far
        self._most = np.concatenate([np.tile(FREE_SIGMA, n_cameras), np.full(n_cameras, RATE_SIGMA)])
        self.P = np.diag(self._most**2)
        self.P[self.offsets, self.offsets] = OFFSET_SIGMA_S**2

    def forget_poses(self) -> None:
        """The poses of the cameras are others."""
        self.P = self._without_poses(range(self._n))
        self.x[self._poses(range(self._n))] = 0.0

    def _poses(self, cameras: Sequence[int]) -> Index:
        """Rows of what is known of cameras beside their clocks."""
        rows = (ERRORS * np.array(cameras)[:, None] + np.arange(ERRORS)).ravel()
        return np.setdiff1d(rows, self.offsets)

    def _without_poses(self, cameras: Sequence[int]) -> Array:
        """The covariance if the poses and lenses of cameras are others."""
        P, rows = self.P.copy(), self._poses(cameras)
        P[rows], P[:, rows] = 0.0, 0.0
        P[rows, rows] = self._most[rows] ** 2
        return P

    def _with_other_clock(self, camera: int) -> Array:
        """The covariance if the clock of a camera jumped, or has another rate."""
        P, clock = self.P.copy(), [self.offsets[camera], self.rates[camera]]
        P[clock, clock] += np.square(CHANGED_SIGMA)
        return P

    def jump(self, camera: int, sigma_s: float, rate_sigma: float) -> None:
        """The stamps of a camera were corrected by a jump with this standard deviation, or may have jumped so far.
        Their rate was corrected until then by as much as `rate_sigma`."""
        self._pending = deque((m for m in self._pending if m[1] != camera), self._pending.maxlen)
        self.P[self.offsets[camera], self.offsets[camera]] += sigma_s**2
        self.P[self.rates[camera], self.rates[camera]] += rate_sigma**2
        self._most[self.rates[camera]] = CHANGED_SIGMA[1]
        self._depart(camera)

    def add_rate(self, t_ns: int, camera: int, rate: float, sigma: float) -> None:
        """Add the rate of a clock by the arrivals of its frames, which is used with the first keyframes after that
        time. If sigma is infinite, the clock may have that rate: it is as uncertain."""
        self._pending.append((t_ns, camera, rate, sigma))

    def predict(self, t_ns: int) -> None:
        """Predict to a time, with the rates by arrivals until then. A rate beyond chance shows that the clock
        changed, or a delay, which the next ones decide."""
        while self._pending and self._pending[0][0] <= t_ns:
            _, camera, rate, sigma = self._pending.popleft()
            row = self.rates[camera]
            off, variance = rate - self.x[row], self.P[row, row] + sigma**2
            if np.isinf(sigma) or off**2 > chdtri(1, FALSE_ALARM) * variance:
                self.P[row, row] = max(self.P[row, row], off**2)
                self._most[row] = max(self._most[row], abs(off))
            else:
                gain = self.P[:, row] / variance
                self.x, self.P = self.x + gain * off, self.P - np.outer(gain, self.P[row])
        self._predict(max(0, t_ns - (self._t_ns or t_ns)) * 1e-9)
        self._t_ns = max(t_ns, self._t_ns)

    def offsets_at(self, t_ns: int) -> tuple[Array, Array]:
        """(C,) offsets as they are known for a time, and their covariance (C, C)."""
        dt = max(0, t_ns - (self._t_ns or t_ns)) * 1e-9
        later = np.zeros((self._n, len(self.x)))
        later[np.arange(self._n), self.offsets], later[np.arange(self._n), self.rates] = 1.0, dt
        walk = RATE_WALK**2 * dt**3 / 3 * np.eye(self._n)
        return later @ self.x, np.asarray(later @ self.P @ later.T + walk, float)

    def _depart(self, camera: int) -> None:
        """At least one clock is held to be right: the windows show differences."""
        self._corrected.add(camera)
        others = [k for k in self.departed if k != camera]
        self.departed = [*others, camera][max(0, len(others) + 2 - self._n) :]

    def update(self, t_ns: int, H: Array, y: Array) -> bool:
        """Add keyframes: least squares H e = y, (8 C, 8 C) and (8 C,), about the cameras' errors at their mean time.

        They show that a clock changed if that explains more than chance, and more than any other clock and any pose
        that is another one. Keyframes that contradict the estimate beyond chance otherwise show that a camera moved,
        even if less than what `judge` finds: its pose must not look like a clock. Then they are not used, and poses are
        forgotten; returns False.
        """
        interval_s = max(0, t_ns - (self._shown_ns or t_ns)) * 1e-9
        self.predict(t_ns)
        self._shown_ns, seen = t_ns, slice(0, len(y))
        off, limit = y - H @ self.x[seen], chdtri(len(y), FALSE_ALARM)
        free = np.linalg.solve(H + np.diag(np.tile(FREE_SIGMA**-2, self._n)), off)

        def explain(P: Array) -> tuple[float, Array]:
            """The cost of the keyframes by an estimate, and its covariance with them."""
            with_them = np.linalg.solve(np.eye(len(P)) + P[:, seen] @ np.pad(H, ((0, 0), (0, self._n))), P)
            return float(off @ (free - with_them[seen, seen] @ off)), np.asarray(with_them, float)

        cost, P = explain(self.P)
        gain, _ = other_offsets(self.P[seen, seen], H, off)
        camera = int(np.argmax(gain))
        if (
            self._n > 2
            and gain[camera] > chdtri(2, FALSE_ALARM)
            and self._is_of_clock(cost - gain, limit, explain)
        ):
            P = explain(self._with_other_clock(camera))[1]
            self._depart(camera)
            self._most[self.rates[camera]] = CHANGED_SIGMA[1]
        elif cost > limit:
            self.forget_poses()
            return False
        self.P = (P + P.T) / 2
        self.x = self.x + self.P[:, seen] @ off
        shown = free[self.offsets]
        self._drift = np.abs(shown - np.median(shown)) / max(interval_s, 1e-9 * INTERVAL_NS)
        return True

    def _is_of_clock(
        self, costs: Array, limit: float, explain: Callable[[Array], tuple[float, Array]]
    ) -> bool:
        """Whether the clock that leaves the lowest of `costs` (C,) explains keyframes, and neither the second best nor
        another pose of a camera does as well."""
        best, rival = np.partition(costs, 1)[:2]
        moved = min(explain(self._without_poses([k]))[0] for k in range(self._n))
        return bool(best <= limit and best + chdtri(2, RIVAL) <= min(rival, moved))

    def _predict(self, dt: float) -> None:
        F, Q = np.eye(len(self.x)), np.zeros_like(self.P)
        F[self.offsets, self.rates] = dt
        walk = RATE_WALK**2 * dt
        Q[self.offsets, self.offsets], Q[self.rates, self.rates] = walk * dt**2 / 3, walk
        Q[self.offsets, self.rates] = Q[self.rates, self.offsets] = walk * dt / 2
        grown = np.full(len(self.x), np.sqrt(1 + dt / MEMORY_S))
        grown[self.offsets], grown[self.rates] = 1.0, 1.0
        self.x, P = F @ self.x, F @ (self.P * np.outer(grown, grown)) @ F.T + Q
        bounded = np.minimum(1.0, self._most / np.sqrt(np.diag(P)))
        self.P = P * np.outer(bounded, bounded)

    def take_departures(self) -> tuple[Departure, ...]:
        """What the stamps of departed cameras are corrected by from now on, after a search for another such camera.

        Its clock may depart as much again: the prior of a good clock does not hold for it.
        """
        of_clocks, own = np.stack([self.offsets, self.rates], axis=1), np.arange(2 * self._n).reshape(-1, 2)
        M = np.linalg.inv(self.P[np.ix_(of_clocks.ravel(), of_clocks.ravel())])
        y = M @ self.x[of_clocks.ravel()]

        def explain(cameras: list[int]) -> tuple[float, Array, Array]:
            rows = own[cameras].ravel()
            covariance = np.linalg.inv(M[np.ix_(rows, rows)])
            alone = covariance @ y[rows]
            return float(y[rows] @ alone), alone.reshape(-1, 2), np.sqrt(np.diag(covariance)).reshape(-1, 2)

        others = [k for k in range(self._n) if k not in self.departed]
        known = explain(self.departed)[0]
        explained = sorted((explain([*self.departed, k])[0] - known, k) for k in others)
        (best, k), rival = explained[-1], explained[-2][0] if len(others) > 1 else 0.0
        self.is_suspicious = len(others) > 1 and best > chdtri(2, RIVAL)
        drift = np.zeros(self._n)  # of a clock that departs: it may go on as it did since the last update
        if len(others) > 1 and best > chdtri(2, FALSE_ALARM) and best - rival > chdtri(2, RIVAL):
            self._depart(k)
            offset_s, rate = np.abs(explain(self.departed)[1][-1])
            clock, drift[k] = of_clocks[k], self._drift[k]
            self.P[clock, clock] += np.square([offset_s, max(rate, drift[k])])
        _, alone, sigma = explain(self.departed)
        sigma[:, 1] = np.hypot(sigma[:, 1], drift[self.departed])
        self.x[of_clocks[self.departed]] -= alone
        departures = [
            Departure(k, self._t_ns, *a.tolist(), *b.tolist())
            for k, a, b in zip(self.departed, alone, sigma, strict=True)
        ]
        others_now = [  # whose corrections stay, known no better than an offset that may be theirs beside these
            Departure(k, self._t_ns, 0.0, 0.0, *np.hypot(of_k[-1], s_of_k[-1]).tolist())
            for k in self._corrected.difference(self.departed)
            for _, of_k, s_of_k in [explain([*self.departed, k])]
        ]
        rates = {d.camera: d.rate for d in departures}  # of which stamps are corrected
        for n, (at_ns, camera, rate, s_rate) in enumerate(self._pending):
            self._pending[n] = at_ns, camera, rate - rates.get(camera, 0.0), s_rate
        if self._n > 2:  # of two, the one that departed before departs again
            self.departed = [
                d.camera for d in departures if d.sigma_s > OFFSET_SIGMA_S or d.rate_sigma > RATE_SIGMA / 2
            ]
        return (*departures, *others_now)
