# SPDX-License-Identifier: BSD-3-Clause
"""The log of all programs, on stderr: one line for each message, and few lines however much happens.

A message's kind is its logger, its format string and its subject, so call `log.warning("camera %s ...", name)` with
constant formats. Lines about cameras and robots that a file declares are of a kind for each: `extra=about(name)`.

`LineLimiter` bounds the lines of each kind and of the process, whatever a network sends.
"""

import contextlib
import logging
import os
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

from camera_node.foundation.errors import MAX_LINE, printable
from camera_node.foundation.line_limits import LineLimiter, LogLimits, Released


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


class LimitedHandler(logging.StreamHandler):
    """Writes the first line of a kind at once; `limits` bound those that follow."""

    def __init__(self, stream: Any = None, limits: LogLimits | None = None) -> None:
        super().__init__(stream)
        self._limiter = LineLimiter(limits)
        self._timer: threading.Timer | None = None
        self._timer_s = 0.0

    def emit(self, record: logging.LogRecord) -> None:
        """Write the line, or hold it back; called with the handler's lock."""
        if self._limiter.hold(record):  # else a timer runs
            self._write_due()

    def close(self) -> None:
        """Write what is held back."""
        with self._locked():
            self._write(self._limiter.release_all())
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

    def _write_due(self) -> None:
        """Write what may be written now; start a timer for the rest."""
        self._write(self._limiter.release())
        if (due_s := self._limiter.due_s()) is not None:
            self._start_timer(due_s)

    def _write(self, lines: list[Released]) -> None:
        for held, record in lines:
            try:
                n_lines = 1 + self.format(record).count("\n")
                super().emit(record)
            except Exception:  # of a format string that does not fit its arguments
                self.handleError(record)
                n_lines = 1
            self._limiter.charge(held, n_lines)

    def _start_timer(self, due_s: float) -> None:
        if self._timer is not None and self._timer_s <= due_s:
            return
        if self._timer is not None:
            self._timer.cancel()
        wait_s = max(0.0, due_s - time.monotonic())
        self._timer, self._timer_s = threading.Timer(wait_s, self._expire), due_s
        self._timer.daemon = True
        self._timer.start()

    def _expire(self) -> None:
        with self._locked():
            self._timer = None
            self._write_due()
