# SPDX-License-Identifier: BSD-3-Clause
"""Gathers the frames of free-running cameras into frame sets. Time comes from the data and the caller, not a clock."""

from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice, pairwise
from statistics import median_low

from fusion.model.frames import CalibratedFrame, FrameSet

RATE_FRAMES = 8  # of one camera, from which its rate and its usual lag are estimated
DEFAULT_PERIOD_NS = 33_333_333  # where no camera sent two frames
MAX_RATE_HZ = 240.0  # of frame sets, where the cameras' rates decide
FAR_FASTER = 2.5  # times the median rate of the cameras: a camera beyond does not decide the rate
SILENT_NS = 500_000_000  # a camera silent for this long is not waited for
MAX_GAP_NS = 2_000_000_000  # a longer silence of all cameras starts a new sequence of frame sets
PERIOD_CHANGE = (
    0.75,
    1.33,
)  # ratios of the fastest camera's interval to the period, between which the period stays
INTERVAL_SLACK = 1.1  # a frame is missing once its camera is this many intervals silent


@dataclass(slots=True)
class _CameraRate:
    """The recent capture times of a camera, and how long after these its frames arrived."""

    times: deque[int] = field(default_factory=lambda: deque(maxlen=RATE_FRAMES))
    lags: deque[int] = field(default_factory=lambda: deque(maxlen=RATE_FRAMES))
    lag_ns: int = 0  # median
    late: int = 0
    interval_ns: int = 0  # median; 0 while it is unknown

    def add(self, t_ns: int) -> None:
        """Add a capture time; times before a long silence are dropped."""
        if self.times and t_ns - self.times[-1] > MAX_GAP_NS:
            self.times.clear()
        self.times.append(t_ns)
        steps = sorted(b - a for a, b in pairwise(self.times))
        self.interval_ns = steps[(len(steps) - 1) // 2] if len(steps) > 1 else 0  # one step may be a pause

    def add_lag(self, lag_ns: int) -> None:
        """Add the time from the capture of a frame to its arrival."""
        self.lags.append(lag_ns)
        self.lag_ns = median_low(self.lags)

    def is_missing(self, end_ns: int) -> bool:
        """Whether a frame is expected before `end_ns`, at the camera's rate, that has not come."""
        return bool(self.times) and self.times[-1] + INTERVAL_SLACK * self.interval_ns < end_ns


class FrameSynchronizer:
    """Closes a frame set when every live camera has delivered its frame, or when the wait limit is reached.

    Frame sets have a constant period. Their phase is that of the first camera by name, whose frames are in the middle
    of their sets. A frame that missed its set is used in the next one at its own time; an older one is dropped and
    counted: constant velocities no longer predict where the robots were then.

    Args:
        period_ns: of the frame sets; without it that of the fastest camera, estimated from its first frames. A camera
            far faster than the median one does not count, and the rate is at most `MAX_RATE_HZ`.
        lateness_ns: the wait limit, from when the set's frames of the fastest camera usually arrive: all cameras may
            be network streams of 0.3 s.
    """

    def __init__(self, period_ns: int | None = None, lateness_ns: int = 150_000_000) -> None:
        self.period_ns = period_ns
        self._is_adaptive = period_ns is None
        self.lateness_ns = lateness_ns
        self._cameras = defaultdict[str, _CameraRate](_CameraRate)
        self._waiting: list[CalibratedFrame] = []
        self._end_ns: int | None = None  # of the open frame set; None while there is none
        self._newest_ns = 0
        self._missing: dict[str, _CameraRate] = {}  # live ones and silent ones, of the set that ends at
        self._missing_end_ns = 0

    @classmethod
    def at_rate(cls, rate_hz: float | None, lateness_ms: float) -> "FrameSynchronizer":
        """A synchronizer of so many frame sets a second; None for the rate of the fastest camera."""
        return cls(round(1e9 / rate_hz) if rate_hz else None, round(lateness_ms * 1e6))

    @property
    def rate_hz(self) -> float | None:
        """Frame sets a second; None before it is known."""
        return 1e9 / self.period_ns if self.period_ns else None

    @property
    def late(self) -> dict[str, int]:
        """Frames dropped since the start, by camera."""
        return {name: camera.late for name, camera in self._cameras.items()}

    @property
    def limit_ns(self) -> int:
        """How long after its capture a frame set waits for a frame: `lateness_ns` more than the frames of the camera
        with the least lag usually take."""
        lags_ns = [camera.lag_ns for camera in self._cameras.values() if self._is_live(camera)]
        return self.lateness_ns + max(0, min(lags_ns, default=0))

    def add(self, frame: CalibratedFrame) -> bool:
        """Add a frame; return False if it is too late."""
        camera = self._cameras[frame.camera]
        camera.add_lag(frame.received_ns - frame.t_ns if frame.received_ns else 0)
        if frame.t_ns < self._oldest_ns():
            camera.late += 1
            return False
        if not camera.times or frame.t_ns > camera.times[-1]:
            camera.add(frame.t_ns)
            self._note(frame.camera, camera)
        self._waiting.append(frame)
        self._newest_ns = max(self._newest_ns, frame.t_ns)
        return True

    def replace_frames(self, replaced: Callable[[CalibratedFrame], CalibratedFrame | None]) -> None:
        """Replace the waiting frames after a change of the calibration; None drops one. Their cameras' rates stay."""
        self._waiting = [frame for frame in map(replaced, self._waiting) if frame is not None]

    def ignore(self, name: str) -> None:
        """Wait no longer for the frames of a camera, until one is added again."""
        if name in self._cameras:
            self._cameras[name].times.clear()
            self._note(name, self._cameras[name])

    def take(self, now_ns: int) -> list[FrameSet]:
        """The frame sets that are closed at `now_ns`: a server's time, or offline the newest capture time."""
        if self._end_ns is None and not self._try_start(now_ns):
            return []
        return self._close(lambda end_ns: self._is_due(end_ns, now_ns), SILENT_NS)

    @property
    def open_ns(self) -> int | None:
        """The time of the next frame set; None before its first frame."""
        if self._end_ns is None or not self.period_ns or not self._waiting:
            return None
        return self._end_ns - self.period_ns // 2

    def opened(self, n_used: int, worth: int) -> FrameSet | None:
        """The frames of the next set that have arrived, if `worth` times as many as are missing are new: not `n_used`.

        With most messages the number of frames that wait decides it.
        """
        if self._end_ns is None or not self.period_ns or (n_new := len(self._waiting) - n_used) < worth:
            return None
        n_missing = sum(1 for _ in islice(self._missing_until(self._end_ns), n_new // worth + 1))
        if not n_missing or n_new < worth * n_missing:
            return None
        opened = self._gather(self._end_ns, self.period_ns)
        return opened if len(opened.frames) - n_used >= worth * n_missing else None

    def finish(self) -> list[FrameSet]:
        """The frame sets of all remaining frames, at the end of a recording."""
        if self._end_ns is None:
            self._start()
        return self._close(lambda end_ns: True, 0) if self._waiting else []

    def _oldest_ns(self) -> int:
        """Frames with earlier capture times are too late."""
        if self._end_ns is None or not self.period_ns:
            return 0
        return self._end_ns - 2 * self.period_ns

    def _try_start(self, now_ns: int) -> bool:
        """Start the sequence of frame sets once the rate is known."""
        if not self._waiting:
            return False
        is_rate_known = any(len(camera.times) == RATE_FRAMES for camera in self._cameras.values())
        oldest_ns = min(frame.t_ns for frame in self._waiting)
        if not (is_rate_known or now_ns - oldest_ns > MAX_GAP_NS):
            return False
        self._start()
        return True

    def _start(self) -> None:
        if not self._waiting:
            return
        if not self.period_ns:
            self.period_ns = self._fastest_interval_ns() or DEFAULT_PERIOD_NS
        first_ns = min(frame.t_ns for frame in self._waiting)
        middle_ns = min(self._waiting, key=lambda frame: (frame.camera, frame.t_ns)).t_ns
        end_ns = middle_ns + self.period_ns // 2
        self._end_ns = end_ns - (end_ns - first_ns - 1) // self.period_ns * self.period_ns

    def _is_live(self, camera: _CameraRate) -> bool:
        return bool(camera.times) and camera.times[-1] > self._newest_ns - SILENT_NS

    def _fastest_interval_ns(self) -> int:
        """The interval of the fastest live camera that is not far faster than the median one, 0 if none is known."""
        intervals = sorted(
            c.interval_ns for c in self._cameras.values() if c.interval_ns > 0 and self._is_live(c)
        )
        if not intervals:
            return 0
        usual_ns = intervals[len(intervals) // 2]  # the slower one of two in the middle
        fastest_ns = next(i for i in intervals if i * FAR_FASTER >= usual_ns)
        return max(fastest_ns, round(1e9 / MAX_RATE_HZ))

    def _adapted_period(self, period_ns: int) -> int:
        """The period, or another one if the rate of the cameras changed, as in dim light or on a busy machine."""
        if not self._is_adaptive:
            return period_ns
        low, high = PERIOD_CHANGE
        fastest_ns = self._fastest_interval_ns()
        return period_ns if fastest_ns <= 0 or low < fastest_ns / period_ns < high else fastest_ns

    def _close(self, is_due: Callable[[int], bool], silence_ns: int) -> list[FrameSet]:
        """Close all frame sets that are due. Without frames, empty sets follow for `silence_ns`: robots become lost."""
        closed = []
        self._shorten()
        while self._end_ns is not None and self.period_ns and is_due(self._end_ns):
            oldest_ns = min((frame.t_ns for frame in self._waiting), default=None)
            if oldest_ns is None and self._end_ns > self._newest_ns + silence_ns:
                break
            if oldest_ns is not None and oldest_ns > self._end_ns + MAX_GAP_NS:
                self._start()
                continue
            closed.append(self._pop(self._end_ns, self.period_ns))
            self.period_ns = self._adapted_period(self.period_ns)
            self._end_ns += self.period_ns
        return closed

    def _shorten(self) -> None:
        """End the open set earlier if its cameras have become faster: a long one would hold many frames of each.

        The rate is computed only where more frames wait than one of each camera: this runs with every message.
        """
        if self._end_ns is None or not self.period_ns or len(self._waiting) <= len(self._cameras):
            return
        period_ns = self._adapted_period(self.period_ns)
        if period_ns < self.period_ns:
            self._end_ns += period_ns - self.period_ns
            self.period_ns = period_ns

    def _pop(self, end_ns: int, period_ns: int) -> FrameSet:
        frame_set = self._gather(end_ns, period_ns)
        self._waiting = [frame for frame in self._waiting if frame.t_ns >= end_ns]
        return frame_set

    def _gather(self, end_ns: int, period_ns: int) -> FrameSet:
        frames = sorted((f for f in self._waiting if f.t_ns < end_ns), key=lambda f: (f.camera, f.t_ns))
        return FrameSet(end_ns - period_ns // 2, tuple(frames))

    def _is_due(self, end_ns: int, now_ns: int) -> bool:
        """Whether the wait limit is reached, or all live cameras have delivered to a set that has begun."""
        has_begun = self.period_ns is not None and now_ns >= end_ns - self.period_ns
        is_complete = has_begun and any(self._is_live(c) for c in self._cameras.values())
        if is_complete and next(self._missing_until(end_ns), None) is None:
            return True
        if (
            now_ns < end_ns + self.lateness_ns
        ):  # with most messages; the limit is at least this, and takes longer
            return False
        return now_ns >= end_ns + self.limit_ns

    def _note(self, name: str, camera: _CameraRate) -> None:
        """Note whether a camera is missing in the open set, after its times changed."""
        if camera.is_missing(self._missing_end_ns):
            self._missing[name] = camera
        else:
            self._missing.pop(name, None)

    def _missing_until(self, end_ns: int) -> Iterator[_CameraRate]:
        """The live cameras that have not delivered a frame that is expected before `end_ns`."""
        if end_ns != self._missing_end_ns:
            self._missing_end_ns = end_ns
            self._missing = {name: c for name, c in self._cameras.items() if c.is_missing(end_ns)}
        return filter(self._is_live, self._missing.values())
