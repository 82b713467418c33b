# SPDX-License-Identifier: BSD-3-Clause
"""`fusion record`: a live arena into an MCAP file."""

from pathlib import Path
from typing import Annotated

import tyro

from calib.rig.recording import RecordingWriter
from camera_node.protocol.session import open_client
from camera_node.terminal import say
from fusion.recordings.record import record_arena


def record(
    out: Path,
    /,
    *,
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",),
    arena: str = "arena",
    zenoh_config: Annotated[Path | None, tyro.conf.arg(name="zenoh")] = None,
    seconds: float | None = None,
) -> int:
    """Record an arena's detections, poses, markers, rig and robots, until stopped.

    Args:
        out: the MCAP file to write.
        connect: the server's Zenoh endpoints.
        arena: the arena's name.
        zenoh_config: a Zenoh configuration (JSON5) for TLS, access control or scouting.
        seconds: the duration; until Ctrl-C unless given.
    """
    with RecordingWriter(out) as writer, open_client(connect, zenoh_config) as session:
        record_arena(session, arena, writer, seconds)
    for key, count in sorted(writer.counts.items()):
        say(f"{count:7} on {key}")
    say(f"wrote {out}")
    return 0
