# SPDX-License-Identifier: BSD-3-Clause
"""`roundel trim`: a part of a recording as a recording."""

from collections import Counter
from pathlib import Path

from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say
from fusion.recordings.recording_files import say_skipped, trim_recording


def trim(
    recording: Path, out: Path, /, *, from_s: float = 0.0, to_s: float = 1e9, force: bool = False
) -> int:
    """Copy a part of a recording (MCAP), with the rig and the robots that held at its start.

    Args:
        recording: the MCAP file.
        out: the file to write.
        from_s: start of the part, seconds after the first message.
        to_s: end of the part, seconds after the first message.
        force: replace what exists.
    """
    if out.exists() and recording.exists() and out.samefile(recording):
        raise ConfigError(f"{out} is the recording itself; give another file")
    if from_s < 0:
        raise ConfigError(f"--from-s is {from_s:g}; the recording begins at 0 s")
    faults = Counter[str]()
    count = trim_recording(recording, out, from_s, to_s, faults, overwrite=force)
    say_skipped(faults)
    say(f"wrote {out}: {count} messages")
    return 0
