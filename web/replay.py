# SPDX-License-Identifier: BSD-3-Clause
"""A recorded arena told again: to a feed, at the pace at which it came or another, from any moment on."""

import re
import threading
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from calib.rig.recording import read_messages
from camera_node.errors import ConfigError
from web.feed import Feed

LEAD_S = 2.0  # told at once before a moment that is jumped to: a status of everybody
TURN_S = 1 / 60
ARENA = re.compile(r"(.+?)/(?:camera/[^/]+/|robot/[^/]+/|fusion/|markers$|rig$)")


class RecordingPlayer:
    """A recording (MCAP) and a clock that can be paused, sped up and put elsewhere; `run` tells a feed what is due.

    Attributes:
        arena: the name of the recorded arena.
        duration_s: from the first message to the last.
    """

    def __init__(self, path: Path) -> None:
        """Reads through the recording once.

        Raises:
            ConfigError: the file is missing, or no recording of an arena.
        """
        self.path = path
        self.faults: Counter[str] = Counter()
        self._rigs: list[tuple[int, str, bytes]] = []
        times: list[int] = []
        arenas: Counter[str] = Counter()
        for key, data, t_ns in read_messages(path, self.faults):
            times = [min(t_ns, *times), max(t_ns, *times)] if times else [t_ns, t_ns]
            if found := ARENA.match(key):
                arenas[found[1]] += 1
                if key == f"{found[1]}/rig":
                    self._rigs.append((t_ns, key, data))
        if not arenas:
            raise ConfigError(f"{path} holds no arena; record with python -m fusion record {path}")
        self.arena = arenas.most_common(1)[0][0]
        self._start_ns = times[0]
        self.duration_s = (times[1] - times[0]) / 1e9
        self._lock = threading.Lock()
        self._at_s, self._since = 0.0, time.monotonic()
        self._speed, self._playing, self._jumped = 1.0, True, True

    def seconds(self) -> float:
        """The moment that is told, from the recording's start; a feed's clock."""
        with self._lock:
            return self._seconds()

    @property
    def playing(self) -> bool:
        """Whether it goes on; it does not when it was paused, or has ended."""
        with self._lock:
            return self._playing and self._seconds() < self.duration_s

    def play(self, playing: bool = True) -> None:
        """Go on, or pause. From the end it begins anew."""
        with self._lock:
            ended = self._seconds() >= self.duration_s
            self._settle(0.0 if playing and ended else self._seconds())
            self._playing, self._jumped = playing, self._jumped or (playing and ended)

    def set_speed(self, speed: float) -> None:
        """How much faster than it was recorded, above 0."""
        with self._lock:
            self._settle(self._seconds())
            self._speed = speed

    def seek(self, seconds: float) -> None:
        """Jump to a moment."""
        with self._lock:
            self._settle(min(max(seconds, 0.0), self.duration_s))
            self._jumped = True

    def run(self, feed: Feed, stop: threading.Event, once: bool = False) -> None:
        """Tell the feed until `stop` is set; or, `once`, set it at the recording's end."""
        feed.server_changed(True)
        for reason, times in self.faults.items():
            for _ in range(times):
                feed.count_fault(reason)
        told = Telling(self, feed)
        while not stop.wait(TURN_S):
            with self._lock:
                jumped, self._jumped = self._jumped, False
            if jumped:
                told = Telling(self, feed)
            try:
                told.until(self.seconds())
            except ConfigError as error:  # the file is gone
                feed.count_fault(str(error)[:120])
            if once and not self.playing:
                stop.set()

    def messages(self, from_s: float) -> Iterator[tuple[float, str, bytes]]:
        """Seconds, key and bytes from a moment on; before them the rig that was in force then."""
        from_ns = self._start_ns + round(from_s * 1e9)
        in_force = bisect_right(self._rigs, from_ns, key=lambda rig: rig[0])
        if in_force:
            yield from_s, *self._rigs[in_force - 1][1:]
        for key, data, t_ns in read_messages(self.path, Counter()):
            if t_ns >= from_ns:
                yield (t_ns - self._start_ns) / 1e9, key, data

    def _seconds(self) -> float:
        passed = (time.monotonic() - self._since) * self._speed if self._playing else 0.0
        return min(self._at_s + passed, self.duration_s)

    def _settle(self, at_s: float) -> None:
        self._at_s, self._since = at_s, time.monotonic()


class Telling:
    """One uninterrupted telling of a recording, from a little before the present moment on."""

    def __init__(self, replay: RecordingPlayer, feed: Feed) -> None:
        feed.forget()
        self._feed = feed
        self._messages = replay.messages(max(0.0, replay.seconds() - LEAD_S))
        self._next = next(self._messages, None)
        self._key_exprs: dict[str, str | None] = {}

    def until(self, seconds: float) -> None:
        """Tell what is due at a moment."""
        while self._next is not None and self._next[0] <= seconds:
            _, key, data = self._next
            if key_expr := self._key_expr(key):
                self._feed.receive(key_expr, key, data)
            self._next = next(self._messages, None)

    def _key_expr(self, key: str) -> str | None:
        if key not in self._key_exprs:
            parts = key.split("/")
            self._key_exprs[key] = next((e for e in self._feed.key_exprs if _includes(e, parts)), None)
        return self._key_exprs[key]


def _includes(key_expr: str, parts: list[str]) -> bool:
    """Whether a key expression in which * stands for one part includes a key."""
    pattern = key_expr.split("/")
    return len(pattern) == len(parts) and all(
        p in ("*", part) for p, part in zip(pattern, parts, strict=True)
    )
