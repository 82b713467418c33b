# SPDX-License-Identifier: BSD-3-Clause
"""Finds cameras whose clocks depart slowly from the others, by an offset or at a rate.

See docs/design/time_offsets.md, section 7.

Information about the offsets is summed over windows of half a second or more. Calibration errors bias an offset, but
the bias is about the same in all windows as long as the robots move alike; a clock that departs changes the offset from
some window on, at once or at a constant rate.

The velocity of a filter follows the stamps of one frame set, right or wrong. So velocities are mean ones over 0.2 s
around the frame set, in which a wrong stamp displaces both ends alike.
"""

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from camera_node.foundation.arrays import Array, Mask
from fusion.model.states import Snapshot, States
from fusion.monitoring.clocks.time_offsets import Disagreement, OffsetInformation, contradiction

WINDOW_NS, WINDOW_PX = 500_000_000, 100.0  # smallest duration of a window, and smallest image motion in it
MAX_WINDOWS, MAX_AGE_NS = 60, 60_000_000_000
HALF_NS = 100_000_000  # before and after a frame set, for the velocities of its robots
RECENT_NS, MIN_NS = 10_000_000_000, 3_000_000_000  # of the windows that show an offset: at most, at least
MIN_BEFORE = 3  # windows before a change
FOLLOWED_PX = 0.15  # that a change of a camera explains which departed before
OFFSET_PX = 0.4  # RMS image motion that an offset explains
SHORT_PX, LONG_PX = 0.45, 0.2  # that a change explains: at first, and after
LONG_PATH_PX = 1500.0  # of image motion since the change, over which calibration errors are independent
MIN_CHANGE_S = 0.0005
MIN_CHI2 = 36.0  # that a change explains, with any of some hundred onsets
NOISE_CHI2 = 11.0  # 99 % of chi-square with three degrees of freedom
PRIOR_FREEDOM = 3.0  # degrees of freedom of the prior variance factor, 1
WEAK = 1.0  # prior information about an offset, 1 / s^2


@dataclass(frozen=True, slots=True)
class Drift:
    """A camera whose clock departs from those of the others.

    Attributes:
        camera: its index.
        since_ns: when it began to depart.
        step_s, rate: true capture time minus stamps at a later t: step_s + rate * (t - since).
        sigma_s: of that now.
    """

    camera: int
    since_ns: int
    step_s: float
    rate: float
    sigma_s: float

    def at(self, t_ns: int) -> float:
        """The offset at a time, s."""
        return self.step_s + self.rate * (t_ns - self.since_ns) * 1e-9 if t_ns >= self.since_ns else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    """The sum of the information from `since_ns` to `until_ns`."""

    since_ns: int
    until_ns: int
    info: OffsetInformation

    @property
    def middle_ns(self) -> int:
        return (self.since_ns + self.until_ns) // 2

    def is_complete(self, t_ns: int) -> bool:
        """Whether the next window begins: calibration errors at other places in the images are independent."""
        seconds = (t_ns - self.since_ns) * 1e-9
        speed_px = np.sqrt(self.info.motion_px2.sum() / max(1.0, self.info.count.sum()))
        return t_ns >= self.since_ns + WINDOW_NS and bool(speed_px * seconds >= WINDOW_PX)


class DriftMonitor:
    """Accumulates the information of frame sets about the offsets of cameras from their corrected stamps."""

    def __init__(self) -> None:
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
        """Drop all information: the poses of cameras changed."""
        self._windows.clear()

    def forget_since(self, t_ns: int) -> None:
        """Drop the windows that reach beyond a time, at which an offset changed at once."""
        while self._windows and self._windows[-1].until_ns >= t_ns:
            self._windows.pop()

    def correct(self, drift: Drift) -> None:
        """Express all information relative to stamps that are corrected by this drift."""
        for k, window in enumerate(self._windows):
            offsets = np.zeros(len(window.info.count))
            offsets[drift.camera] = drift.at(window.middle_ns)
            self._windows[k] = replace(window, info=window.info.relative_to(offsets))

    def offsets(self) -> list[Drift]:
        """Cameras with an offset in the last windows, whenever it began."""
        if not self._windows:
            return []
        now_ns = self._windows[-1].until_ns
        recent = [w for w in self._windows if w.since_ns > now_ns - RECENT_NS]
        if not recent or now_ns < recent[0].since_ns + MIN_NS:
            return []
        parts = _Parts.of(recent)
        M, y = parts.M.sum(0), parts.y.sum(0)
        found = contradiction(M, y, parts.speed_px, OFFSET_PX)
        return [Drift(k, self._windows[0].since_ns, x, 0.0, sigma) for k, x, sigma in _rows(found)]

    def changes(self, departing: Collection[int] = ()) -> list[Drift]:
        """Cameras whose offset changed from some window on, at once or at a constant rate.

        Args:
            departing: indices of the cameras that are known to depart: smaller changes count.
        """
        windows = [w for w in self._windows if len(np.flatnonzero(w.info.count)) > 1]
        if len(windows) <= MIN_BEFORE:
            return []
        since_ns = [w.since_ns for w in windows[MIN_BEFORE:]]
        now_ns, at_ns = windows[-1].until_ns, np.array([w.middle_ns for w in windows])
        steps = (at_ns >= np.array(since_ns)[:, None]).astype(float)
        ramps = np.maximum(0.0, (at_ns - np.array([windows[1].since_ns, *since_ns])[:, None]) * 1e-9)
        parts = _Parts.of(windows)
        M, y, factor, best = parts.best_change(np.concatenate([steps, ramps]))
        if best < 0:
            return []
        is_step = best < len(steps)
        onset_ns = since_ns[best] if is_step else [windows[1].since_ns, *since_ns][best - len(steps)]
        span = 1.0 if is_step else (now_ns - onset_ns) * 1e-9
        path_px = float(parts.speed_px.mean()) * (now_ns - onset_ns) * 1e-9
        min_px = LONG_PX if path_px > LONG_PATH_PX else SHORT_PX
        if path_px <= LONG_PATH_PX:  # calibration errors are correlated so far: only their allowance counts
            factor = max(factor, 1.0)
        found = contradiction(M / factor, y / factor, parts.speed_px * span, FOLLOWED_PX, NOISE_CHI2)
        return [
            Drift(k, onset_ns, x * is_step, x * (not is_step), sigma * span)
            for k, x, sigma in _rows(found)
            if abs(x) * span > MIN_CHANGE_S and (k in departing or abs(x) * span * parts.speed_px[k] > min_px)
        ]


@dataclass(frozen=True, slots=True, eq=False)
class _Parts:
    """The information of W windows about the offsets of C cameras, shifts of the images eliminated.

    Attributes:
        M, y: (W, C, C) and (W, C).
        speed_px: (C,) RMS image speed, px/s.
    """

    M: Array
    y: Array
    speed_px: Array

    @classmethod
    def of(cls, windows: Sequence[_Window]) -> "_Parts":
        parts = [w.info.with_unknown_shifts() for w in windows]
        motion_px2 = np.sum([w.info.motion_px2 for w in windows], 0)
        count = np.sum([w.info.count for w in windows], 0)
        speed_px = np.sqrt(motion_px2 / np.maximum(1.0, count))
        return cls(np.array([part[0] for part in parts]), np.array([part[1] for part in parts]), speed_px)

    def best_change(self, courses: Array) -> tuple[Array, Array, float, int]:
        """M (C, C) and y (C,) of the changes with the best course, the offsets before eliminated.

        Args:
            courses: (K, W) of the changes over time, in each window.

        Returns:
            M, y, the variance of the windows about this course relative to the one that the information states, and
            the row of the course; -1 if none explains enough.
        """
        n = self.y.shape[1]
        A = self.M.sum(0) + WEAK * np.eye(n)
        B, D = np.einsum("kw,wij->kij", courses, self.M), np.einsum("kw,wij->kij", courses**2, self.M)
        by_offset = np.linalg.solve(A, np.concatenate([B, self._total[None, :, None].repeat(len(B), 0)], 2))
        M = D - B @ by_offset[:, :, :n]
        y = courses @ self.y - np.einsum("kij,kj->ki", B, by_offset[:, :, n])
        explained = np.einsum("ki,kij,kj->k", y, np.linalg.pinv(M, rcond=1e-6, hermitian=True), y)
        best = int(np.argmax(explained))
        squares = sum(_explained(*part) for part in zip(self.M, self.y, strict=True))
        squares -= _explained(A, self._total) + explained[best]
        freedom = max(0, len(self.y) - 2) * (np.count_nonzero(self.speed_px) - 1)
        factor = (max(float(squares), 0.0) + PRIOR_FREEDOM) / (freedom + PRIOR_FREEDOM)
        return M[best], y[best], factor, best if explained[best] > MIN_CHI2 * factor else -1

    @property
    def _total(self) -> Array:
        return self.y.sum(0)


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
