# SPDX-License-Identifier: BSD-3-Clause
"""Writes a recording as a sequence of files of limited size or duration, each readable by itself."""

import re
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from calib.rig.recording import RecordingWriter
from camera_node.foundation.errors import ConfigError
from fusion.recordings.context import Context


@dataclass(frozen=True)
class Rotation:
    """When the next file begins: at a size or after a time; None does not limit.

    Raises:
        ConfigError: a limit is not positive.
    """

    max_mb: float | None = None
    max_minutes: float | None = None

    def __post_init__(self) -> None:
        for option, value in (("--rotate-mb", self.max_mb), ("--rotate-minutes", self.max_minutes)):
            if value is not None and not 0 < value < 1e9:
                raise ConfigError(f"{option} {value:g} is not above 0; give the size or the time of one file")

    def __bool__(self) -> bool:
        return self.max_mb is not None or self.max_minutes is not None

    def is_due(self, size: int, age_s: float) -> bool:
        """Whether a file of `size` bytes, begun `age_s` ago, is complete."""
        too_big = self.max_mb is not None and size >= 1e6 * self.max_mb
        return too_big or (self.max_minutes is not None and age_s >= 60 * self.max_minutes)


class RotatingWriter:
    """Writes `NAME-001.mcap`, `NAME-002.mcap` and so on; a context manager. Existing files stay, the numbers go on.

    Args:
        path: `NAME.mcap`.
        rotation: when the next file begins.

    Raises, at entry and in `put`:
        ConfigError: a file can't be written, or the disk is full.
    """

    def __init__(self, path: Path, rotation: Rotation) -> None:
        self.counts: Counter[str] = Counter()  # of messages in all files, by key
        self._path, self._rotation = path, rotation
        self._context = Context()
        self._number = last_number(path)

    def __enter__(self) -> "RotatingWriter":
        self._open()
        return self

    def __exit__(self, *exception: object) -> None:
        self._writer.__exit__(*exception)

    @property
    def path(self) -> Path:
        """The present file."""
        return self._writer.path

    def put(self, key: str, data: bytes, received_ns: int) -> None:
        """Append a message that arrived on a key; begin the next file where it is due."""
        if self._rotation.is_due(self._writer.size, time.monotonic() - self._begun_s):
            self._writer.__exit__()
            self._open()
            for held in self._context.held.items():
                self._writer.put(*held, received_ns)
        self._writer.put(key, data, received_ns)
        self.counts[key] += 1
        self._context.add(key, data)

    def _open(self) -> None:
        self._number += 1
        name = f"{self._path.stem}-{self._number:03}{self._path.suffix}"
        self._writer = RecordingWriter(self._path.with_name(name), overwrite=False).__enter__()
        self._begun_s = time.monotonic()


def last_number(path: Path) -> int:
    """The highest number of the files beside `path` that a rotation wrote, 0 without any."""
    numbered = re.compile(rf"{re.escape(path.stem)}-([0-9]+){re.escape(path.suffix)}")
    matches = map(numbered.fullmatch, (p.name for p in path.parent.glob("*"))) if path.parent.is_dir() else ()
    return max((int(match[1]) for match in matches if match), default=0)
