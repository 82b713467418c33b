# SPDX-License-Identifier: BSD-3-Clause
"""`roundel repair`: makes a recording that was cut off readable by every MCAP reader."""

import shutil
from collections import Counter
from pathlib import Path

from calib.rig.recording import new_recording, read_messages
from calib.rig.recording_reader import ReadLimits
from calib.rig.recording_repair import repair_recording
from camera_node.foundation.config import new_path
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say
from fusion.recordings.recording_files import say_skipped


def repair(recording: Path, /, *, out: Path | None = None, max_chunk_mb: float | None = None) -> int:
    """Complete a recording (MCAP) that was cut off or damaged, as after a power failure, for every MCAP reader.

    The unfinished end is removed; damaged parts are marked, so that readers skip them, and stay in the file.

    Args:
        recording: the MCAP file; changed in place unless --out is given.
        out: write a completed copy here instead.
        max_chunk_mb: read chunks and messages up to this size, in MB, and write them in smaller ones; with --out. Files
            of other programs may need it; a hostile file takes as much memory.
    """
    if max_chunk_mb is not None:
        return _rewrite(recording, out, max_chunk_mb)
    if out is not None:
        _copy(recording, out)
    path = out or recording
    result = repair_recording(path)
    say_skipped(result.faults)
    if result.was_complete:
        say(f"{path} is complete: {result.n_messages} messages")
    elif result.lost_bytes:
        say(
            f"repaired {path}: {result.n_messages} messages; {result.lost_bytes} bytes of an unfinished chunk removed"
        )
    else:
        say(f"repaired {path}: {result.n_messages} messages")
    return 0


def _rewrite(recording: Path, out: Path | None, max_chunk_mb: float) -> int:
    if out is None or not max_chunk_mb > 0:
        raise ConfigError("--max-chunk-mb writes a new file; give a size above 0, and --out")
    size, faults = round(1e6 * max_chunk_mb), Counter[str]()
    with new_recording(out, overwrite=False) as writer:
        for entry in read_messages(recording, faults, ReadLimits(size, size)):
            writer.put(*entry)
    say_skipped(faults)
    say(f"wrote {out}: {writer.counts.total()} messages")
    return 0


def _copy(recording: Path, out: Path) -> None:
    if out.exists():
        raise ConfigError(f"{out} exists; give another name")
    if not recording.is_file():
        raise ConfigError(f"{recording} does not exist; give a recording")
    with new_path(out) as part:
        shutil.copyfile(recording, part)
