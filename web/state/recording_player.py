# SPDX-License-Identifier: BSD-3-Clause
"""Plays a recording into a feed: pause, speed and jumps."""

import re
import threading
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import zenoh

from calib.rig.recording import read_messages
from camera_node.foundation.errors import ConfigError
from fusion.protocol.pose_messages import robots_key
from web.state.feed import Feed

LEAD_S = 2.0  # a jump also replays the messages of so long before it: one status of every program
STEP_S = 1 / 60
ARENA = re.compile(r"(.+?)/(?:camera/[^/]+/|robot/[^/]+/|fusion/|markers$|rig$|robots$)")


class RecordingPlayer:
    """A recording (MCAP) with a clock that can pause, change its speed and jump. `run` plays it into a feed.

    Attributes:
        arena: name of the recorded arena.
        duration_s: time from the first message to the last.
        start_s: Unix time of the first message.
    """

    def __init__(self, path: Path) -> None:
        """Read the recording once, for its time span, its arena, its calibrations and its robots.

        Raises:
            ConfigError: the file is missing, or is not a recording of an arena.
        """
        self.path = path
        self.faults: Counter[str] = Counter()
        # Messages that are valid until the next one of their key.
        self._held: dict[str, list[tuple[int, str, bytes]]] = {"rig": [], "robots": []}
        times: list[int] = []
        arenas: Counter[str] = Counter()
        for key, data, t_ns in read_messages(path, self.faults):
            times = [min(t_ns, *times), max(t_ns, *times)] if times else [t_ns, t_ns]
            if found := ARENA.match(key):
                arenas[found[1]] += 1
                if (held := key.removeprefix(f"{found[1]}/")) in self._held:
                    self._held[held].append((t_ns, key, data))
        if not arenas:
            raise ConfigError(f"{path} has no messages of an arena; record it with roundel record {path}")
        self.arena = arenas.most_common(1)[0][0]
        self._start_ns = times[0]
        self.start_s = times[0] / 1e9
        self.duration_s = (times[1] - times[0]) / 1e9
        self._lock = threading.Lock()
        self._position_s, self._position_set_at = 0.0, time.monotonic()
        self._speed, self._playing, self._jumped = 1.0, True, True
        self._part_s = 0.0, self.duration_s

    def seconds(self) -> float:
        """Return the current position, seconds from the start of the recording; the clock for a feed."""
        with self._lock:
            return self._seconds()

    @property
    def playing(self) -> bool:
        """Whether the position advances: not while paused, and not at the end."""
        with self._lock:
            return self._playing and self._seconds() < self._part_s[1]

    @property
    def part_s(self) -> tuple[float, float]:
        """Start and end of the part that is played, seconds."""
        return self._part_s

    def select_part(self, from_s: float, to_s: float) -> None:
        """Play only a part; a position outside of it moves to its start."""
        with self._lock:
            here = self._seconds()
            begin = min(max(from_s, 0.0), self.duration_s)
            self._part_s = begin, max(begin, min(to_s, self.duration_s))
            if not self._part_s[0] <= here <= self._part_s[1]:
                self._set_position(self._part_s[0])
                self._jumped = True

    def play(self, playing: bool = True) -> None:
        """Play or pause. Playing at the end of the part starts from its beginning."""
        with self._lock:
            restart = playing and self._seconds() >= self._part_s[1]
            self._set_position(self._part_s[0] if restart else self._seconds())
            self._playing, self._jumped = playing, self._jumped or restart

    def set_speed(self, speed: float) -> None:
        """Set the speed relative to the recording, above 0."""
        with self._lock:
            self._set_position(self._seconds())
            self._speed = speed

    def seek(self, seconds: float) -> None:
        """Jump to a position in the part that is played."""
        with self._lock:
            self._set_position(min(max(seconds, self._part_s[0]), self._part_s[1]))
            self._jumped = True

    def step(self, seconds: float) -> None:
        """Pause, and advance by some seconds."""
        with self._lock:
            self._set_position(min(self._seconds() + seconds, self._part_s[1]))
            self._playing = False

    def run(self, feed: Feed, stop: threading.Event, once: bool = False) -> None:
        """Play into a feed until `stop` is set; with `once`, set it at the end of the recording."""
        feed.note_arena(feed.keys.arena, True)
        for reason, count in self.faults.items():
            feed.count_fault(reason, count)
        playback = self._start_pass(feed)
        while not stop.wait(STEP_S):
            with self._lock:
                jumped, self._jumped = self._jumped, False
            if jumped:
                playback = self._start_pass(feed)
            try:
                playback.advance(self.seconds())
            except ConfigError as error:  # the file was removed
                feed.count_fault(str(error)[:120])
            if once and not self.playing:
                stop.set()

    def messages(self, from_s: float) -> Iterator[tuple[float, str, bytes]]:
        """Yield seconds, key and bytes from a position on, after the calibration and the robots of that position."""
        from_ns = self._start_ns + round(from_s * 1e9)
        for held in self._held.values():
            if n_before := bisect_right(held, from_ns, key=lambda message: message[0]):
                yield from_s, *held[n_before - 1][1:]
        for key, data, t_ns in read_messages(self.path, Counter(), from_ns=from_ns):
            yield (t_ns - self._start_ns) / 1e9, key, data

    def _start_pass(self, feed: Feed) -> "RecordingPass":
        feed.clear()
        return RecordingPass(self.messages(max(0.0, self.seconds() - LEAD_S)), feed)

    def _seconds(self) -> float:
        passed = (time.monotonic() - self._position_set_at) * self._speed if self._playing else 0.0
        return min(self._position_s + passed, self._part_s[1])

    def _set_position(self, seconds: float) -> None:
        self._position_s, self._position_set_at = seconds, time.monotonic()


class RecordingPass:
    """Passes messages (seconds, key, bytes) to a feed in their order, each when it is due."""

    def __init__(self, messages: Iterator[tuple[float, str, bytes]], feed: Feed) -> None:
        self._feed, self._messages = feed, messages
        self._next = next(self._messages, None)
        self._expressions = [zenoh.KeyExpr(text) for text in (*feed.key_exprs, robots_key(feed.keys.arena))]
        self._expression_of: dict[str, str | None] = {}  # by key

    def advance(self, seconds: float) -> None:
        """Feed all messages up to a position."""
        while self._next is not None and self._next[0] <= seconds:
            _, key, data = self._next
            if key_expr := self._find_expression(key):
                self._feed.receive(key_expr, key, data)
            self._next = next(self._messages, None)

    def _find_expression(self, key: str) -> str | None:
        """Return the key expression of the feed that includes a key; None if there is none or the key is invalid."""
        if key not in self._expression_of:
            self._expression_of[key] = next((str(e) for e in self._expressions if _includes(e, key)), None)
        return self._expression_of[key]


def _includes(expression: zenoh.KeyExpr, key: str) -> bool:
    try:
        return expression.includes(zenoh.KeyExpr(key))
    except zenoh.ZError:  # a recording may hold any text as a key
        return False
