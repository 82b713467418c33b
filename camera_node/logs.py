# SPDX-License-Identifier: BSD-3-Clause
"""The log of all programs, on stderr: one line for each message, and few lines however much happens.

A message's kind is its logger, its format string and its subject, so call `log.warning("camera %s ...", name)` with
constant formats. Lines about cameras and robots that a file declares are of a kind for each: `extra=about(name)`.
"""

import logging
import os
import sys
import threading
import time
from dataclasses import dataclass
from typing import Any

from camera_node.text import printable

FIRST_S = 1.0  # least interval between lines of one kind; it doubles while they keep coming ...
LONGEST_S = 60.0  # ... up to this
MAX_KINDS = 256  # further ones are limited together


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
        record.message = printable(record.message)
        return super().formatMessage(record)

    def formatException(self, ei: Any) -> str:
        return "\n".join(f"| {printable(line)}" for line in super().formatException(ei).splitlines())


@dataclass
class _Kind:
    """Lines of one kind: when the next one may be written, and those held back until then."""

    interval_s: float
    due_s: float
    held: int = 0
    last: logging.LogRecord | None = None


class LimitedHandler(logging.StreamHandler):
    """Writes the first line of a kind at once, then the last of each interval with the number of those left out."""

    def __init__(self, stream: Any = None, first_s: float = FIRST_S) -> None:
        super().__init__(stream)
        self._first_s = first_s
        self._kinds: dict[object, _Kind] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Write the line, or hold it back; called with the handler's lock."""
        kind = self._kind_of(record)
        if kind.last is None and time.monotonic() >= kind.due_s:
            kind.due_s = time.monotonic() + kind.interval_s
            super().emit(record)
            return
        kind.held += 1
        if kind.last is None:
            timer = threading.Timer(max(0.0, kind.due_s - time.monotonic()), self._release, [kind])
            timer.daemon = True
            timer.start()
        kind.last = record

    def close(self) -> None:
        """Write what is held back."""
        for kind in list(self._kinds.values()):
            self._release(kind)
        super().close()

    def _release(self, kind: _Kind) -> None:
        self.acquire()
        try:
            record, held, kind.last, kind.held = kind.last, kind.held, None, 0
            kind.interval_s = min(2 * kind.interval_s, LONGEST_S)
            kind.due_s = time.monotonic() + kind.interval_s
            if record is not None:
                super().emit(_counted(record, held))
        finally:
            self.release()

    def _kind_of(self, record: logging.LogRecord) -> _Kind:
        """The kind of a record; one that was silent for longer than its interval starts again."""
        now_s = time.monotonic()
        key = (record.name, record.levelno, record.msg, getattr(record, "subject", None))
        if key not in self._kinds and len(self._kinds) >= MAX_KINDS:
            self._kinds = {k: kind for k, kind in self._kinds.items() if kind.last or now_s < kind.due_s}
            key = key if len(self._kinds) < MAX_KINDS else None
        kind = self._kinds.setdefault(key, _Kind(self._first_s, 0.0))
        if kind.last is None and now_s > kind.due_s + kind.interval_s:
            kind.interval_s = self._first_s
        return kind


def _counted(record: logging.LogRecord, held: int) -> logging.LogRecord:
    """The record with the number of lines that it stands for."""
    if held == 1:
        return record
    counted = logging.makeLogRecord(record.__dict__)
    counted.msg, counted.args = f"{record.getMessage()} ({held} lines like this)", ()
    return counted
