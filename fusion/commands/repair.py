# SPDX-License-Identifier: BSD-3-Clause
"""`roundel repair`: makes a recording that was cut off readable by every MCAP reader."""

import shutil
from pathlib import Path

from calib.rig.recording_repair import repair_recording
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say


def repair(recording: Path, /, *, out: Path | None = None) -> int:
    """Complete a recording (MCAP) that was cut off, as after a power failure. Only its unfinished end is lost.

    Args:
        recording: the MCAP file; changed in place unless --out is given.
        out: write a completed copy here instead.
    """
    if out is not None:
        _copy(recording, out)
    path = out or recording
    result = repair_recording(path)
    if result.was_complete:
        say(f"{path} is complete: {result.n_messages} messages")
    else:
        say(
            f"repaired {path}: {result.n_messages} messages; {result.lost_bytes} bytes of an unfinished chunk removed"
        )
    return 0


def _copy(recording: Path, out: Path) -> None:
    if out.exists():
        raise ConfigError(f"{out} exists; give another name")
    try:
        shutil.copyfile(recording, out)
    except OSError as error:
        raise ConfigError(
            f"{recording} can't be copied to {out}: {error.strerror}; check both paths"
        ) from None
