# SPDX-License-Identifier: BSD-3-Clause
"""Which lines of a log are written, and when: few of each kind and of the process, whatever a network sends.

A message's kind is its logger, its level, its format string and its subject. A line that a limit holds back is counted;
the last one of its kind is written with the count as soon as the limits permit.
"""

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from camera_node.foundation.errors import printable
from camera_node.foundation.rate_limit import RateLimit

MAX_KINDS = 256  # further ones are limited together
DIGEST_KINDS = 16  # quoted in a digest ...
DIGEST_TEXT = 100  # ... with so many characters of each
DIGEST_LINE = 2500  # characters of a digest
Released = tuple[int, logging.LogRecord]  # how many lines this one stands for, and the line


@dataclass(frozen=True)
class LogLimits:
    """How many lines are written at once, and how often after that.

    Attributes:
        pause_s: after the first line of a kind. It grows by `growth` with each line of the kind, so that a flood that
            has lasted for T has written log(T / pause_s) / log(growth) lines, ...
        growth: of the pause.
        longest_pause_s: ... up to this, ...
        quiet_s: ... and halves with each such time without the kind, ...
        quiet_share: ... or with this share of the pause if that is longer: a camera that comes and goes once a minute
            for days does not write a line a minute. What is held back is written after a quiet time as well, which is a
            quarter of an hour at most.
        lines: of all kinds at once; those of a traceback count ...
        line_s: ... then one in this time. A line that stands for others, as a digest of all kinds that were held back
            does, costs as many lines as it stands for, ...
        most_lines: ... but at most so many: an event during a flood waits for at most so many times `line_s`.
        separate: recurring kinds that are held back, up to which each has lines of its own. More share a digest and
            one pause, so that a flood of all kinds writes as many lines as one of a single kind.
    """

    pause_s: float = 1.0
    growth: float = 4.0
    longest_pause_s: float = 3600.0
    quiet_s: float = 60.0
    quiet_share: float = 0.25
    lines: int = 32
    line_s: float = 1.0
    most_lines: int = 10
    separate: int = 3


class _Pause:
    """The time between two lines: it grows with each line, and halves with each quiet time."""

    def __init__(self, limits: LogLimits) -> None:
        self._limits = limits
        self._pause_s = 0.0
        self._written_s = self._last_s = -math.inf

    @property
    def due_s(self) -> float:
        return min(self._written_s + self._pause_s, self.quiet_from_s)

    @property
    def quiet_from_s(self) -> float:
        """When a quiet time will have passed."""
        return self._last_s + self._quiet_s(self._pause_s)

    def at(self, now_s: float) -> float:
        """What is left of the pause, s; 0 after the quiet time that follows the shortest one."""
        pause_s, quiet_from_s = self._pause_s, self.quiet_from_s
        while pause_s and now_s >= quiet_from_s:
            pause_s = pause_s / 2 if pause_s > self._limits.pause_s else 0.0
            quiet_from_s += self._quiet_s(pause_s)
        return pause_s

    def recurs(self, now_s: float) -> bool:
        """Whether a line was written of late: not more than one quiet time ago for each line."""
        return self.at(now_s) > self._limits.pause_s / 2

    def _quiet_s(self, pause_s: float) -> float:
        return max(self._limits.quiet_s, self._limits.quiet_share * pause_s)

    def is_quiet(self, now_s: float) -> bool:
        """Whether nothing happened for a quiet time."""
        return now_s >= self.quiet_from_s

    def note(self, now_s: float) -> None:
        """Something is to be written."""
        self._pause_s, self._last_s = self.at(now_s), now_s

    def restart(self, now_s: float) -> None:
        """A line is written."""
        limits = self._limits
        self._pause_s = min(max(limits.pause_s, limits.growth * self._pause_s), limits.longest_pause_s)
        self._written_s = now_s


class _Kind:
    """The lines of one kind that are held back, and when the next one may be written."""

    def __init__(self, limits: LogLimits) -> None:
        self.pause = _Pause(limits)
        self._last: logging.LogRecord | None = None
        self.held = 0

    def hold(self, record: logging.LogRecord, now_s: float) -> None:
        self.pause.note(now_s)
        self.held, self._last = self.held + 1, record

    def release(self, now_s: float) -> Released:
        """The last line, and the number of those that it stands for."""
        assert self._last is not None
        held, record = self.held, self._last
        self.held, self._last = 0, None
        self.pause.restart(now_s)
        return held, record


class LineLimiter:
    """Decides which lines are written, and when. Not safe to use from several threads.

    Args:
        limits: of the lines.
        clock: the time, s.
    """

    def __init__(self, limits: LogLimits | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self._limits, self._clock = limits or LogLimits(), clock
        self._allowance = RateLimit(1 / self._limits.line_s, self._limits.lines, clock)
        self._kinds: dict[object, _Kind] = {}
        self._digest_pause = _Pause(self._limits)

    def hold(self, record: logging.LogRecord) -> bool:
        """Hold a line back; whether it is the first of its kind, so that `due_s` may be earlier than before."""
        kind = self._kind_of(record)
        kind.hold(record, self._clock())
        if self._in_flood(self._held()):
            self._digest_pause.note(self._clock())
        return kind.held == 1

    def due_s(self) -> float | None:
        """When `release` is to be called; None if nothing is held back."""
        held = self._held()
        flood = self._in_flood(held)
        due_s = [kind.pause.quiet_from_s if kind in flood else kind.pause.due_s for kind in held]
        if flood:
            due_s.append(self._digest_pause.due_s)
        return max(self._allowance.due_s(), min(due_s)) if due_s else None

    def release(self) -> list[Released]:
        """A line for each kind whose time has come, or one for all of them if the process may not write as many.

        Many kinds that recur are a flood: they share one line, and their pause.
        """
        now_s = self._clock()
        if now_s < self._allowance.due_s():
            return []
        held = self._held()
        flood = self._in_flood(held)
        due = [kind for kind in held if kind not in flood and kind.pause.due_s <= now_s]
        together = [kind for kind in due if kind.pause.recurs(now_s)]  # such as those of a flood that is over
        if len(together) <= self._limits.separate:
            together = []
        if flood and now_s >= self._digest_pause.due_s:
            self._digest_pause.restart(now_s)
            together += flood
        return self._release([kind for kind in due if kind not in together], together)

    def release_all(self) -> list[Released]:
        """What is held back, at once."""
        return self._release(self._held(), [])

    def charge(self, held: int, lines: int) -> None:
        """Count what was written: lines of text, which stand for `held` lines."""
        self._allowance.take(max(lines, min(held, self._limits.most_lines)))

    def _held(self) -> list[_Kind]:
        return [kind for kind in self._kinds.values() if kind.held]

    def _in_flood(self, held: list[_Kind]) -> list[_Kind]:
        """Those that recur, if they are many."""
        now_s = self._clock()
        recurring = [kind for kind in held if kind.pause.recurs(now_s) and not kind.pause.is_quiet(now_s)]
        return recurring if len(recurring) > self._limits.separate else []

    def _release(self, single: list[_Kind], together: list[_Kind]) -> list[Released]:
        """A line for each of the first kinds, if the process may write as many, and one for the others."""
        if len(single) > max(1.0, self._allowance.left()):
            single, together = [], single + together
        lines = [(held, _counted(held, record)) for held, record in self._take(single)]
        released = self._take(together)
        return lines + ([(sum(held for held, _ in released), _digest(released))] if released else [])

    def _take(self, kinds: list[_Kind]) -> list[Released]:
        now_s = self._clock()
        return [kind.release(now_s) for kind in kinds]

    def _kind_of(self, record: logging.LogRecord) -> _Kind:
        """The kind of a record. Kinds without lines of late make room for others."""
        key = (record.name, record.levelno, record.msg, getattr(record, "subject", None))
        if key not in self._kinds and len(self._kinds) >= MAX_KINDS:
            now_s, kinds = self._clock(), self._kinds
            self._kinds = {k: kind for k, kind in kinds.items() if kind.held or kind.pause.recurs(now_s)}
            key = key if len(self._kinds) < MAX_KINDS else None
        if key not in self._kinds:
            self._kinds[key] = _Kind(self._limits)
        return self._kinds[key]


def _counted(held: int, record: logging.LogRecord) -> logging.LogRecord:
    """The record with the number of lines that it stands for."""
    if held == 1:
        return record
    counted = logging.makeLogRecord(record.__dict__)
    counted.msg, counted.args = _text(record) + _count(held), ()
    return counted


def _text(record: logging.LogRecord) -> str:
    """The message; its format string alone if that does not fit the arguments."""
    try:
        return record.getMessage()
    except Exception:
        return str(record.msg)


def _count(held: int) -> str:
    return f" ({held} lines like this)" if held > 1 else ""


def _digest(released: list[Released]) -> logging.LogRecord:
    """One line for several kinds: the severe ones first, then the rare ones, which repetitions must not hide."""
    ordered = sorted(released, key=lambda pair: (-pair[1].levelno, pair[0]))
    texts = [printable(_text(r), DIGEST_TEXT) + _count(held) for held, r in ordered[:DIGEST_KINDS]]
    if len(ordered) > DIGEST_KINDS:
        texts.append(f"{len(ordered) - DIGEST_KINDS} other kinds")
    total, level = sum(held for held, _ in released), ordered[0][1].levelno
    text = f"{total} lines of {len(released)} kinds: {'; '.join(texts)}"
    return logging.makeLogRecord(
        {"name": "log", "levelno": level, "levelname": logging.getLevelName(level)}
        | {"msg": text, "limit": DIGEST_LINE}
    )
