# SPDX-License-Identifier: BSD-3-Clause
"""Lists recordings with their length, cameras and robots, from the index at a file's end: no message is read."""

import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from calib.rig.recording import new_recording, read_messages
from calib.rig.recording_reader import RecordingReader
from camera_node.foundation.config import require_name
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say
from fusion.recordings.context import Context

KEY = re.compile(r".+?/(camera|robot)/([^/]+)/(?:detections|pose)")
SUFFIX = ".mcap"
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
            reader = RecordingReader(file)
    except ConfigError:
        return RecordingSummary(path, size)
    if reader.statistics is None:
        return RecordingSummary(path, size)
    named = [found for key in reader.keys.values() if (found := KEY.fullmatch(key))]
    names = {kind: tuple(sorted({m[2] for m in named if m[1] == kind})) for kind in ("camera", "robot")}
    seconds = (reader.statistics.end_ns - reader.statistics.start_ns) / 1e9
    return RecordingSummary(path, size, seconds, names["camera"], names["robot"])


def list_recordings(folder: Path) -> list[RecordingSummary]:
    """The recordings (*.mcap) of a folder, the newest first."""
    times_ns: dict[Path, int] = {}
    for path in folder.glob(f"*{SUFFIX}"):
        with suppress(OSError):  # it was removed or renamed just now
            times_ns[path] = path.stat().st_mtime_ns
    found = []
    for path in sorted(times_ns, key=lambda path: times_ns[path], reverse=True)[:MAX_FILES]:
        with suppress(OSError):
            found.append(summarize_recording(path))
    return found


def recording_path(folder: Path, name: str) -> Path:
    """The file of a recording with a name, with or without its suffix. Raises ConfigError for what is no name."""
    return folder / f"{require_name(name.removesuffix(SUFFIX), 'a recording')}{SUFFIX}"


def rename_recording(recording: Path, name: str) -> Path:
    """Give a recording another name in its folder; return its new path.

    Raises:
        ConfigError: it is no recording, the name is invalid or taken, or the folder can't be written.
    """
    _require_recording(recording)
    new = recording_path(recording.parent, name)
    if new.exists():
        raise ConfigError(f"{new} exists; give another name")
    try:
        return recording.rename(new)
    except OSError as error:
        raise ConfigError(f"{recording} can't be renamed: {error.strerror}") from None


def remove_recording(recording: Path) -> None:
    """Delete a recording for good. Raises ConfigError if it is no recording, or its folder can't be written."""
    _require_recording(recording)
    try:
        recording.unlink()
    except OSError as error:
        raise ConfigError(f"{recording} can't be removed: {error.strerror}") from None


def _require_recording(path: Path) -> None:
    if path.suffix != SUFFIX:
        raise ConfigError(f"{path} is no recording; name a file that ends with {SUFFIX}")
    if not path.is_file():
        raise ConfigError(
            f"{path} does not exist; roundel recordings list {path.parent} lists the recordings"
        )


def say_skipped(faults: Counter[str]) -> None:
    """Print what of a recording was skipped, one line a reason."""
    for reason, count in sorted(faults.items()):
        say(f"skipped: {count} {reason}")


def trim_recording(
    recording: Path,
    out: Path,
    from_s: float,
    to_s: float,
    faults: Counter[str] | None = None,
    overwrite: bool = False,
) -> int:
    """Write the messages that arrived from `from_s` to `to_s` after the first one, and what held at `from_s`: the
    rig, the robots and the states of the cameras and the server (`Context`). `faults` counts what could not be read.

    Returns:
        the number of messages in the part.

    Raises:
        ConfigError: no message is in the part, the recording can't be read, or `out` exists and is not to be
            replaced, or can't be written.
    """
    if not 0 <= from_s < to_s:
        raise ConfigError(f"a part from {from_s:g} s to {to_s:g} s is empty; give --from-s below --to-s")
    faults = Counter[str]() if faults is None else faults
    start_ns, last_ns = 0, 0
    for n, (*_, t_ns) in enumerate(read_messages(recording, faults)):
        start_ns, last_ns = (min(start_ns, t_ns), max(last_ns, t_ns)) if n else (t_ns, t_ns)
    begin_ns, end_ns = (start_ns + round(s * 1e9) for s in (from_s, min(to_s, 1e9)))
    with new_recording(out, overwrite) as writer:
        n_context = 0
        for is_context, entry in _part(recording, begin_ns, end_ns, faults):
            writer.put(*entry)
            n_context += is_context
        if not writer.counts:
            length_s = (last_ns - start_ns) / 1e9
            raise ConfigError(f"{recording} has no message after {from_s:g} s; it is {length_s:.1f} s long")
    return writer.counts.total() - n_context


def _part(
    recording: Path, begin_ns: int, end_ns: int, faults: Counter[str]
) -> Iterator[tuple[bool, tuple[str, bytes, int]]]:
    """Messages that arrived in a part, each with whether it is older and holds in the part, if there are any."""
    context = Context()
    for key, data, t_ns in read_messages(recording, faults):
        if t_ns < begin_ns:
            context.add(key, data)
        elif t_ns <= end_ns:
            for earlier, held in context.held.items():
                yield True, (earlier, held, begin_ns)
            context.held.clear()
            yield False, (key, data, t_ns)
