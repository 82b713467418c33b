# SPDX-License-Identifier: BSD-3-Clause
"""`roundel record`: a live arena into an MCAP file."""

from pathlib import Path

from calib.rig.recording import RecordingWriter
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.service import stopped_by_signals
from camera_node.foundation.terminal import say
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions
from fusion.recordings.arena_recording import NO_ROBOTS, ArenaRecorder
from fusion.recordings.recording_files import SUFFIX
from fusion.recordings.rotation import RotatingWriter, Rotation


def record(
    out: Path,
    /,
    *,
    connection: ConnectionOptions = LOCAL_SERVER,
    seconds: float | None = None,
    rotate_mb: float | None = None,
    rotate_minutes: float | None = None,
    public: bool = False,
    force: bool = False,
) -> int:
    """Record an arena's detections, poses, markers, rig and robots, until stopped.

    Args:
        out: the MCAP file to write.
        connection: the arena's server.
        seconds: the duration; until Ctrl-C or SIGTERM unless given.
        rotate_mb: begin the next file, OUT-001.mcap, OUT-002.mcap and so on, at this size, megabytes.
        rotate_minutes: begin the next file after this time, minutes.
        public: write also a picture of one camera each second, and the versions of this installation, so that others
            can repeat and judge what it shows (docs/benchmark.md).
        force: replace an existing file.
    """
    if out.suffix != SUFFIX:
        raise ConfigError(f"{out} does not end in {SUFFIX}; write {out.with_name(out.name + SUFFIX)}")
    rotation = Rotation(rotate_mb, rotate_minutes)
    opened = RotatingWriter(out, rotation) if rotation else RecordingWriter(out, overwrite=force)
    with (
        stopped_by_signals() as stop,
        opened as writer,
        connection.wait() as waiting,
    ):
        recorder = ArenaRecorder(waiting, connection.arena, writer, public)
        recorder.run(stop, seconds)
    for key, count in sorted(writer.counts.items()):
        say(f"{count:7} on {key}")
    for reason, count in recorder.lost.items():
        say(f"not written: {count} {reason}")
    say(f"wrote {writer.path}")
    if recorder.robots == frozenset():
        say(f"warning: {NO_ROBOTS}")
    if not writer.counts:
        say(
            f"warning: the recording is empty: no message of arena '{connection.arena}' arrived from "
            f"{' '.join(connection.connect)}"
        )
        return 1
    return 0
