# SPDX-License-Identifier: BSD-3-Clause
"""Frames of free-running cameras, gathered into frame sets. Time comes from the data and the caller, never a clock."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

from fusion.model.frames import CalibratedFrame, FrameSet

LEARN_FRAMES = 8  # of one camera, from which its rate is learnt
DEFAULT_NS = 33_333_333  # the period where no camera sent two frames
GONE_NS = 500_000_000  # a camera silent for so long is not waited for
MAX_GAP_NS = 2_000_000_000  # a longer silence of all cameras starts a new row of instants


@dataclass(slots=True)
class _Camera:
    """What is known of a camera's rhythm."""

    times: deque[int] = field(default_factory=lambda: deque(maxlen=LEARN_FRAMES))
    late: int = 0
    interval_ns: int = 0  # median

    def note(self, t_ns: int) -> None:
        """Take a frame's time; what came before a long silence is another rhythm's."""
        if self.times and t_ns - self.times[-1] > MAX_GAP_NS:
            self.times.clear()
        self.times.append(t_ns)
        steps = sorted(b - a for a, b in pairwise(self.times))
        self.interval_ns = (steps[len(steps) // 2] + steps[(len(steps) - 1) // 2]) // 2 if steps else 0


class FrameSynchronizer:
    """Closes an instant when every live camera delivered what belongs to it, or when it is too late to wait.

    Instants follow each other steadily. Their phase is that of the first camera by name, so that its frames lie in
    the middle of theirs. A frame that missed its instant is used in the next at its own time, unless it is older
    than that by more than `lateness_ns`: then it is dropped and counted.
    """

    def __init__(self, period_ns: int | None = None, lateness_ns: int = 150_000_000) -> None:
        """Start empty; without `period_ns` the rate is that of the fastest camera, learnt from its first frames."""
        self.period_ns = period_ns
        self._learns = period_ns is None
        self.lateness_ns = lateness_ns
        self._cameras: dict[str, _Camera] = {}
        self._waiting: list[CalibratedFrame] = []
        self._end_ns: int | None = None  # of the instant that is open; None while there is none
        self._newest_ns = 0

    @property
    def late(self) -> dict[str, int]:
        """Frames dropped since the start, by camera."""
        return {name: camera.late for name, camera in self._cameras.items()}

    def add(self, frame: CalibratedFrame) -> bool:
        """Take a frame; False if it came too late."""
        camera = self._cameras.setdefault(frame.camera, _Camera())
        if frame.t_ns < self._oldest_ns():
            camera.late += 1
            return False
        if not camera.times or frame.t_ns > camera.times[-1]:
            camera.note(frame.t_ns)
        self._waiting.append(frame)
        self._newest_ns = max(self._newest_ns, frame.t_ns)
        return True

    def take(self, now_ns: int) -> list[FrameSet]:
        """The instants that are complete at `now_ns`: a server's time, or offline the newest capture time."""
        if self._end_ns is None and not self._begin(now_ns):
            return []
        return self._close(lambda end: self._complete(end) or now_ns >= end + self.lateness_ns, GONE_NS)

    def open(self) -> tuple[FrameSet | None, int]:
        """What is there already of the instant that is closed next, and how many cameras it waits for."""
        if self._end_ns is None or not self.period_ns or not self._waiting:
            return None, 0
        opened = self._gather(self._end_ns, self.period_ns)
        return (opened if opened.frames else None), self._owing(self._end_ns)

    def finish(self) -> list[FrameSet]:
        """The instants of all frames that are left, at the end of a recording."""
        if self._end_ns is None:
            self._start()
        return self._close(lambda end: True, 0) if self._waiting else []

    def _oldest_ns(self) -> int:
        """Capture times before this come too late."""
        if self._end_ns is None or not self.period_ns:
            return 0
        return self._end_ns - self.period_ns - self.lateness_ns

    def _begin(self, now_ns: int) -> bool:
        """Start the row of instants once the rate is known."""
        if not self._waiting:
            return False
        learnt = any(len(camera.times) == LEARN_FRAMES for camera in self._cameras.values())
        oldest = min(frame.t_ns for frame in self._waiting)
        if not (learnt or now_ns - oldest > MAX_GAP_NS):
            return False
        self._start()
        return True

    def _start(self) -> None:
        if not self._waiting:
            return
        if not self.period_ns:
            self.period_ns = self._fastest_ns() or DEFAULT_NS
        first = min(frame.t_ns for frame in self._waiting)
        middle = min(self._waiting, key=lambda frame: (frame.camera, frame.t_ns)).t_ns
        end = middle + self.period_ns // 2
        self._end_ns = end - (end - first - 1) // self.period_ns * self.period_ns

    def _fastest_ns(self) -> int:
        """The interval of the fastest camera that lives, 0 where none is known."""
        live = (
            c.interval_ns
            for c in self._cameras.values()
            if c.times and c.times[-1] > self._newest_ns - GONE_NS
        )
        return min((interval for interval in live if interval > 0), default=0)

    def _has_changed(self, period_ns: int) -> bool:
        """Whether cameras keep another rhythm than they did: in dim light, or on a busy machine."""
        fastest = self._fastest_ns()
        return fastest > 0 and not 0.75 < fastest / period_ns < 1.33

    def _close(self, is_due: Callable[[int], bool], silence_ns: int) -> list[FrameSet]:
        """Cut what is due; without frames to come, go on for `silence_ns` so that robots are known to be lost."""
        closed = []
        while self._end_ns is not None and self.period_ns and is_due(self._end_ns):
            oldest = min((frame.t_ns for frame in self._waiting), default=None)
            if oldest is None and self._end_ns > self._newest_ns + silence_ns:
                break
            if oldest is not None and oldest > self._end_ns + MAX_GAP_NS:
                self._start()
                continue
            closed.append(self._cut(self._end_ns, self.period_ns))
            if self._learns and self._has_changed(self.period_ns):
                self.period_ns = self._fastest_ns()
            self._end_ns += self.period_ns
        return closed

    def _cut(self, end_ns: int, period_ns: int) -> FrameSet:
        instant = self._gather(end_ns, period_ns)
        self._waiting = [frame for frame in self._waiting if frame.t_ns >= end_ns]
        return instant

    def _gather(self, end_ns: int, period_ns: int) -> FrameSet:
        frames = sorted((f for f in self._waiting if f.t_ns < end_ns), key=lambda f: (f.camera, f.t_ns))
        return FrameSet(end_ns - period_ns // 2, tuple(frames))

    def _complete(self, end_ns: int) -> bool:
        return not self._owing(end_ns)

    def _owing(self, end_ns: int) -> int:
        """How many live cameras owe a frame of the instant, were they to keep their rhythms (to a tenth)."""
        live = (c for c in self._cameras.values() if c.times and c.times[-1] > self._newest_ns - GONE_NS)
        return sum(c.times[-1] + 1.1 * c.interval_ns < end_ns for c in live)
