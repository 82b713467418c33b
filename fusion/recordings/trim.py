# SPDX-License-Identifier: BSD-3-Clause
"""Copies a part of a recording, which is a recording itself."""

from collections import Counter
from pathlib import Path

from calib.rig.recording import RecordingWriter, read_messages
from camera_node.foundation.errors import ConfigError

CONTEXT = (
    "/rig",
    "/robots",
    "/status",
)  # ends of keys whose latest message before the part still holds in it


def trim_recording(recording: Path, out: Path, from_s: float, to_s: float) -> int:
    """Write the messages that arrived from `from_s` to `to_s` after the first one, and what held at `from_s`: the
    rig, the robots and the states of the cameras and the server.

    Returns:
        the number of messages in the part.

    Raises:
        ConfigError: no message is in the part, the recording can't be read, or `out` exists or can't be written.
    """
    if not 0 <= from_s < to_s:
        raise ConfigError(f"a part from {from_s:g} s to {to_s:g} s is empty; give --from-s below --to-s")
    faults: Counter[str] = Counter()
    start_ns = min((t_ns for *_, t_ns in read_messages(recording, faults)), default=0)
    begin_ns, end_ns = (start_ns + round(s * 1e9) for s in (from_s, min(to_s, 1e9)))
    context: dict[str, bytes] = {}
    n_written = 0
    with RecordingWriter(out, overwrite=False) as writer:
        for key, data, t_ns in read_messages(recording, faults):
            if t_ns < begin_ns and key.endswith(CONTEXT):
                context[key] = data
            if not begin_ns <= t_ns <= end_ns:
                continue
            if not n_written:
                for earlier, held in context.items():
                    writer.put(earlier, held, begin_ns)
            writer.put(key, data, t_ns)
            n_written += 1
    if not n_written:
        out.unlink()
        raise ConfigError(f"{recording} has no message from {from_s:g} s to {to_s:g} s after its start")
    return n_written
