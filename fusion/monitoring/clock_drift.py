# SPDX-License-Identifier: BSD-3-Clause
"""Finds cameras whose clocks depart slowly from the others, by an offset or at a rate; docs/time_offsets.md section 3.

Information about the offsets is summed over windows of 2 s or more. Calibration errors bias an offset, but the bias is
about the same in all windows as long as the robots move alike; a drift changes the offset from window to window at a
constant rate.

The velocity of a filter follows the stamps of one frame set, right or wrong. So velocities are mean ones over 0.2 s
around the frame set, in which a wrong stamp displaces both ends alike.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from camera_node.arrays import Array, Mask
from fusion.model.states import States
from fusion.monitoring.time_offsets import Disagreement, OffsetInformation, contradiction
from fusion.monitoring.time_search import Snapshot

WINDOW_NS, WINDOW_PX = 2_000_000_000, 300.0  # smallest duration of a window, and smallest image motion in it
MAX_WINDOWS, MAX_AGE_NS = 16, 60_000_000_000
HALF_NS = 100_000_000  # before and after a frame set, for the velocities of its robots
RECENT = 5  # windows that show an offset, with the open one
MIN_NS = 3_000_000_000  # of the windows that show an offset
MIN_WINDOWS = 4  # complete ones that show a rate
OFFSET_PX, RATE_PX = 0.4, 0.2  # RMS image motion that an offset explains, and the change of one at a rate
MIN_CHANGE_S = 0.0005  # of the offset in all windows, by a rate
NOISE_CHI2 = 11.0  # 99 % of chi-square with three degrees of freedom
PRIOR_FREEDOM = 3.0  # degrees of freedom of the prior variance factor, 1
WEAK = 1.0  # prior information about an offset, 1 / s^2


@dataclass(frozen=True, slots=True)
class Drift:
    """A camera whose clock departs from those of the others.

    Attributes:
        camera: its index.
        offset_s, sigma_s: true capture time minus its stamps now, before any correction.
        ppm: rate of the departure, 1e-6; 0 for an offset without a known rate.
    """

    camera: int
    offset_s: float
    sigma_s: float
    ppm: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    """The sum of the information from `since_ns` to `until_ns`."""

    since_ns: int
    until_ns: int
    info: OffsetInformation

    def is_complete(self, t_ns: int) -> bool:
        """Whether the next window begins: calibration errors at other places in the images are independent."""
        seconds = (t_ns - self.since_ns) * 1e-9
        speed_px = np.sqrt(self.info.motion_px2.sum() / max(1.0, self.info.count.sum()))
        return t_ns >= self.since_ns + WINDOW_NS and bool(speed_px * seconds >= WINDOW_PX)


class DriftMonitor:
    """Accumulates the information of frame sets about the offsets of `n_cameras` cameras, before any correction."""

    def __init__(self, n_cameras: int) -> None:
        self._n = n_cameras
        self._windows: deque[_Window] = deque(maxlen=MAX_WINDOWS + 1)

    def add(self, t_ns: int, info: OffsetInformation) -> bool:
        """Add the information of a frame set; whether a window was completed by it."""
        while self._windows and self._windows[0].since_ns < t_ns - MAX_AGE_NS:
            self._windows.popleft()
        if self._windows and not self._windows[-1].is_complete(t_ns):
            last = self._windows.pop()
            self._windows.append(_Window(last.since_ns, t_ns, last.info.plus(info)))
            return False
        self._windows.append(_Window(t_ns, t_ns, info))
        return len(self._windows) > 1

    def forget(self) -> None:
        """Drop all information: an offset changed at once."""
        self._windows.clear()

    def offsets(self, corrections_s: Array) -> list[Drift]:
        """Cameras with an offset in the last windows that differs from the corrections (C,) in use."""
        recent = list(self._windows)[-RECENT:]
        if not recent or recent[-1].until_ns < recent[0].since_ns + MIN_NS:
            return []
        lines = _Lines.of(recent, recent[-1].until_ns)
        found = contradiction(*lines.offsets(corrections_s), lines.speed_px, OFFSET_PX)
        return [Drift(k, offset + corrections_s[k], sigma) for k, offset, sigma in _rows(found)]

    def rates(self, t_ns: int) -> list[Drift]:
        """Cameras whose offsets change at a constant rate, and their offsets at `t_ns`."""
        windows = [w for w in list(self._windows)[:-1] if len(np.flatnonzero(w.info.count)) > 1]
        if len(windows) < MIN_WINDOWS:
            return []
        lines = _Lines.of(windows, t_ns)
        span_s = (windows[-1].until_ns - windows[0].since_ns) * 1e-9
        found = contradiction(*lines.rates(), lines.speed_px * span_s, RATE_PX, NOISE_CHI2)
        drifting = [k for k, rate, _ in _rows(found) if abs(rate) * span_s > MIN_CHANGE_S]
        return lines.fit(drifting) if drifting else []


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Least squares about the offsets of C cameras as linear functions of time.

    Attributes:
        M: (3, C, C) sums of the information of the windows, times 1, t and t^2; t is the time until now, s (negative).
        y: (2, C) sums of the right sides, times 1 and t.
        factor: variance of the windows about the lines, relative to the one that the information states.
        speed_px: (C,) RMS image speed, px/s.
    """

    M: Array
    y: Array
    factor: float
    speed_px: Array

    @classmethod
    def of(cls, windows: Sequence[_Window], now_ns: int) -> "_Lines":
        """Fit all cameras to the windows; the factor has a weak prior of 1."""
        t = np.array([(w.since_ns + w.until_ns) / 2 - now_ns for w in windows]) * 1e-9
        parts = [w.info.with_unknown_shifts() for w in windows]
        M, y = np.array([part[0] for part in parts]), np.array([part[1] for part in parts])
        lines = cls(
            np.array([np.einsum("w,wij->ij", t**k, M) for k in range(3)]),
            np.array([y.sum(0), t @ y]),
            1.0,
            np.sqrt(
                sum(w.info.motion_px2 for w in windows) / np.maximum(1.0, sum(w.info.count for w in windows))
            ),
        )
        squares = sum(_explained(*part) for part in zip(M, y, strict=True))
        squares -= _explained(lines.M[0], lines.y[0]) + _explained(*lines.rates())
        freedom = max(0, len(t) - 2) * (np.count_nonzero(lines.speed_px) - 1)
        factor = (max(squares, 0.0) + PRIOR_FREEDOM) / (freedom + PRIOR_FREEDOM)
        return cls(lines.M, lines.y, float(factor), lines.speed_px)

    def offsets(self, known_s: Array) -> tuple[Array, Array]:
        """M (C, C) and y (C,) of the mean offsets minus the known ones (C,)."""
        return self.M[0] / self.factor, (self.y[0] - self.M[0] @ known_s) / self.factor

    def rates(self) -> tuple[Array, Array]:
        """M (C, C) and y (C,) of the rates alone, the offsets eliminated."""
        n = self.y.shape[1]
        by_offset = np.linalg.solve(self.M[0] + WEAK * np.eye(n), np.column_stack([self.M[1], self.y[0]]))
        M = self.M[2] - self.M[1] @ by_offset[:, :n]
        return M / self.factor, (self.y[1] - self.M[1] @ by_offset[:, n]) / self.factor

    def fit(self, cameras: list[int]) -> list[Drift]:
        """The lines of these cameras, if all others have the offset 0."""
        at, n = np.ix_(cameras, cameras), len(cameras)
        M = np.block([[self.M[0][at], self.M[1][at]], [self.M[1][at], self.M[2][at]]]) / self.factor
        inverse = np.linalg.inv(M)
        solution = inverse @ self.y[:, cameras].ravel() / self.factor
        sigma = np.sqrt(np.diag(inverse))
        return [
            Drift(k, float(solution[i]), float(sigma[i]), 1e6 * float(solution[n + i]))
            for i, k in enumerate(cameras)
        ]


def _explained(M: Array, y: Array) -> float:
    """The sum of squares that the solution of M x = y explains."""
    return float(y @ np.linalg.pinv(M, rcond=1e-6, hermitian=True) @ y)


def _rows(found: Disagreement | None) -> list[tuple[int, float, float]]:
    """Camera, value and standard deviation of each camera at fault."""
    return list(zip(*found.columns, strict=True)) if found else []


def with_mean_velocities(snapshot: Snapshot, history: Sequence[Snapshot]) -> tuple[States, Mask]:
    """The states of a snapshot with mean velocities around it; and which robots were tracked all the time.

    Args:
        snapshot: one of `history`.
        history: to `HALF_NS` after the snapshot.
    """
    first = min(history, key=lambda s: abs(s.t_ns - snapshot.t_ns + HALF_NS))
    last = min(history, key=lambda s: abs(s.t_ns - snapshot.t_ns - HALF_NS))
    seconds = max(1, last.t_ns - first.t_ns) * 1e-9
    is_central = abs(first.t_ns + last.t_ns - 2 * snapshot.t_ns) < HALF_NS // 2
    v = (last.states.p - first.states.p) / seconds
    return replace(snapshot.states, v=v), first.tracked & snapshot.tracked & last.tracked & is_central
