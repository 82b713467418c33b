# SPDX-License-Identifier: BSD-3-Clause
"""The log of all programs, on stderr: one line for each message, and few lines however much happens.

A message's kind is its logger, its format string and its subject, so call `log.warning("camera %s ...", name)` with
constant formats. Lines about cameras and robots that a file declares are of a kind for each: `extra=about(name)`.

`LogLimits` bounds the lines of each kind and of the process, whatever a network sends. A line that a limit holds back
is counted; the last one of its kind is written with the count as soon as the limits permit.
"""

import contextlib
import logging
import os
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from camera_node.rate_limit import RateLimit
from camera_node.text import MAX_LINE, printable

MAX_KINDS = 256  # further ones are limited together
DIGEST_KINDS = 16  # quoted in a digest ...
DIGEST_TEXT = 100  # ... with so many characters of each
DIGEST_LINE = 2500  # characters of a digest


@dataclass(frozen=True)
class LogLimits:
    """How many lines are written at once, and how often after that.

    Attributes:
        spacing_s: between two lines of one kind.
        kind_lines: of one kind at once ...
        kind_s: ... then one in this time.
        lines: of all kinds at once; those of a traceback count ...
        line_s: ... then one in this time. A line that stands for others, as a digest of all kinds that were held back
            does, costs as many lines as it stands for, ...
        most_lines: ... but at most so many: events are written soon, and a flood is one line a minute.
    """

    spacing_s: float = 1.0
    kind_lines: int = 6
    kind_s: float = 60.0
    lines: int = 32
    line_s: float = 2.0
    most_lines: int = 30


def about(name: str) -> dict[str, str]:
    """The `extra` of a line about a camera or robot that a file declares, which no other's line may hold back."""
    return {"subject": name}


def set_up_logging(level: int = logging.INFO) -> None:
    """Write the log of this process to stderr, without the lines of OpenCV, which repeat errors of this project."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET
    if cv2 := sys.modules.get("cv2"):  # it read the variable when it was imported
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    handler = LimitedHandler()
    handler.setFormatter(LineFormatter("%(levelname)s %(name)s %(message)s"))
    logging.basicConfig(level=level, handlers=[handler])


class LineFormatter(logging.Formatter):
    """Writes a message on one line and escapes what is not printable; the lines of a traceback start with `| `."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        record.message = printable(record.message, getattr(record, "limit", MAX_LINE))
        return super().formatMessage(record)

    def formatException(self, ei: Any) -> str:
        return "\n".join(f"| {printable(line)}" for line in super().formatException(ei).splitlines())


class _Kind:
    """The lines of one kind: those that may be written, and those that are held back."""

    def __init__(self, limits: LogLimits) -> None:
        self._spacing_s = limits.spacing_s
        self._written_s = -limits.spacing_s
        self.allowance = RateLimit(1 / limits.kind_s, limits.kind_lines)
        self.held = 0
        self.last: logging.LogRecord | None = None

    @property
    def due_s(self) -> float:
        return max(self._written_s + self._spacing_s, self.allowance.due_s())

    @property
    def is_idle(self) -> bool:
        """Whether nothing is held back, and as many lines may be written as ever."""
        return not self.held and self.allowance.left() >= self.allowance.burst

    def hold(self, record: logging.LogRecord) -> None:
        self.held, self.last = self.held + 1, record

    def release(self, now_s: float) -> tuple[int, logging.LogRecord]:
        """The last line, and the number of those that it stands for."""
        assert self.last is not None
        held, record = self.held, self.last
        self.held, self.last, self._written_s = 0, None, now_s
        self.allowance.take()
        return held, record


class LimitedHandler(logging.StreamHandler):
    """Writes the first line of a kind at once; `limits` bound those that follow."""

    def __init__(self, stream: Any = None, limits: LogLimits | None = None) -> None:
        super().__init__(stream)
        self._limits = limits or LogLimits()
        self._allowance = RateLimit(1 / self._limits.line_s, self._limits.lines)
        self._kinds: dict[object, _Kind] = {}
        self._timer: threading.Timer | None = None
        self._timer_s = 0.0

    def emit(self, record: logging.LogRecord) -> None:
        """Write the line, or hold it back; called with the handler's lock."""
        kind = self._kind_of(record)
        kind.hold(record)
        if kind.held == 1:  # else a timer runs
            self._write_due(time.monotonic())

    def close(self) -> None:
        """Write what is held back."""
        with self._locked():
            self._write(self._waiting(), time.monotonic())
            if self._timer is not None:
                self._timer.cancel()
        super().close()

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        self.acquire()
        try:
            yield
        finally:
            self.release()

    def _waiting(self) -> list[_Kind]:
        return [kind for kind in self._kinds.values() if kind.held]

    def _write_due(self, now_s: float) -> None:
        """Write the kinds whose time has come, if the process may write; start a timer for the others."""
        waiting = self._waiting()
        if now_s >= self._allowance.due_s():
            self._write([kind for kind in waiting if kind.due_s <= now_s], now_s)
            waiting = self._waiting()
        if waiting:
            self._start_timer(max(self._allowance.due_s(), min(kind.due_s for kind in waiting)), now_s)

    def _write(self, kinds: list[_Kind], now_s: float) -> None:
        """Write a line for each kind, or one for all if the process may not write as many."""
        as_digest = len(kinds) > max(1.0, self._allowance.left())
        released = [kind.release(now_s) for kind in kinds]
        held = [sum(held for held, _ in released)] if as_digest else [held for held, _ in released]
        records = [_digest(released)] if as_digest else [_counted(*pair) for pair in released]
        try:
            for number, record in zip(held, records, strict=True):
                lines = 1 + self.format(record).count("\n")
                self._allowance.take(max(lines, min(number, self._limits.most_lines)))
                super().emit(record)
        except Exception:  # of a format string that does not fit its arguments
            self.handleError(released[0][1])

    def _start_timer(self, due_s: float, now_s: float) -> None:
        if self._timer is not None and self._timer_s <= due_s:
            return
        if self._timer is not None:
            self._timer.cancel()
        self._timer, self._timer_s = threading.Timer(max(0.0, due_s - now_s), self._expire), due_s
        self._timer.daemon = True
        self._timer.start()

    def _expire(self) -> None:
        with self._locked():
            self._timer = None
            self._write_due(time.monotonic())

    def _kind_of(self, record: logging.LogRecord) -> _Kind:
        """The kind of a record. Kinds without lines of late make room for others."""
        key = (record.name, record.levelno, record.msg, getattr(record, "subject", None))
        if key not in self._kinds and len(self._kinds) >= MAX_KINDS:
            self._kinds = {k: kind for k, kind in self._kinds.items() if not kind.is_idle}
            key = key if len(self._kinds) < MAX_KINDS else None
        if key not in self._kinds:
            self._kinds[key] = _Kind(self._limits)
        return self._kinds[key]


def _counted(held: int, record: logging.LogRecord) -> logging.LogRecord:
    """The record with the number of lines that it stands for."""
    if held == 1:
        return record
    counted = logging.makeLogRecord(record.__dict__)
    counted.msg, counted.args = record.getMessage() + _count(held), ()
    return counted


def _count(held: int) -> str:
    return f" ({held} lines like this)" if held > 1 else ""


def _digest(released: list[tuple[int, logging.LogRecord]]) -> logging.LogRecord:
    """One line for several kinds: the severe ones first, then the rare ones, which repetitions must not hide."""
    ordered = sorted(released, key=lambda pair: (-pair[1].levelno, pair[0]))
    texts = [printable(r.getMessage(), DIGEST_TEXT) + _count(held) for held, r in ordered[:DIGEST_KINDS]]
    if len(ordered) > DIGEST_KINDS:
        texts.append(f"{len(ordered) - DIGEST_KINDS} other kinds")
    total, level = sum(held for held, _ in released), ordered[0][1].levelno
    text = f"{total} lines of {len(released)} kinds: {'; '.join(texts)}"
    return logging.makeLogRecord(
        {"name": "log", "levelno": level, "levelname": logging.getLevelName(level)}
        | {"msg": text, "limit": DIGEST_LINE}
    )
