# SPDX-License-Identifier: BSD-3-Clause
"""The file of the audit: lines are appended and forced to the disk, and its size is bounded."""

import contextlib
import os
from pathlib import Path

MAX_BYTES = 10_000_000  # of one file
MAX_OLD = 9  # files before it: `audit.jsonl.1` is the newest of them


class AuditFile:
    """Appends lines. A file that would exceed `max_bytes` becomes `<name>.1`, that one `<name>.2` and so on.

    Args:
        path: of the present file.
        max_bytes: of each file; a longer line has a file of its own.

    Attributes:
        path: as given.

    All methods raise OSError if the disk refuses.
    """

    def __init__(self, path: Path, max_bytes: int = MAX_BYTES) -> None:
        self.path, self._max_bytes = path, max_bytes

    def append(self, line: bytes) -> None:
        """Append a line without its line feed, and force it to the disk."""
        line += b"\n"
        with contextlib.suppress(FileNotFoundError):
            if self.path.stat().st_size + len(line) > self._max_bytes:
                self._rotate()
        handle = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o640)
        try:
            os.write(handle, line)
            os.fsync(handle)
        finally:
            os.close(handle)

    def _rotate(self) -> None:
        """Renaming replaces the oldest file; each step is atomic."""
        for number in range(MAX_OLD, 0, -1):
            with contextlib.suppress(FileNotFoundError):
                os.replace(self._old(number - 1), self._old(number))

    def _old(self, number: int) -> Path:
        return self.path.with_name(f"{self.path.name}.{number}") if number else self.path
