# SPDX-License-Identifier: BSD-3-Clause
"""Lists recordings with their length, cameras and robots, from the index at a file's end: no message is read."""

import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import make_reader

KEY = re.compile(r".+?/(camera|robot)/([^/]+)/(?:detections|pose)")
MAX_FILES = 200  # of one folder, the newest


@dataclass(frozen=True)
class RecordingSummary:
    """What a recording holds.

    Attributes:
        path: the file.
        size_bytes: of the file.
        seconds: from the first message to the last; None if the file has no index, as while it is written.
        cameras: their names.
        robots: their names.
    """

    path: Path
    size_bytes: int
    seconds: float | None = None
    cameras: tuple[str, ...] = ()
    robots: tuple[str, ...] = ()


def summarize_recording(path: Path) -> RecordingSummary:
    """Read the index of a recording; raises OSError if the file can't be read."""
    size = path.stat().st_size
    try:
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
    except (McapError, ValueError, EOFError, OSError):  # OSError: its end is sought before its beginning
        summary = None
    if summary is None or summary.statistics is None:
        return RecordingSummary(path, size)
    statistics = summary.statistics
    named = [found for channel in summary.channels.values() if (found := KEY.fullmatch(channel.topic))]
    names = {kind: tuple(sorted({m[2] for m in named if m[1] == kind})) for kind in ("camera", "robot")}
    seconds = (statistics.message_end_time - statistics.message_start_time) / 1e9
    return RecordingSummary(path, size, seconds, names["camera"], names["robot"])


def list_recordings(folder: Path) -> list[RecordingSummary]:
    """The recordings (*.mcap) of a folder, the newest first."""
    times_ns: dict[Path, int] = {}
    for path in folder.glob("*.mcap"):
        with suppress(OSError):  # it was removed or renamed just now
            times_ns[path] = path.stat().st_mtime_ns
    found = []
    for path in sorted(times_ns, key=lambda path: times_ns[path], reverse=True)[:MAX_FILES]:
        with suppress(OSError):
            found.append(summarize_recording(path))
    return found
