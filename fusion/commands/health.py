# SPDX-License-Identifier: BSD-3-Clause
"""`roundel health`: the state of a running arena in one line and an exit code, for people and monitoring systems."""

import json as json_format
from datetime import UTC, datetime

import msgspec

from camera_node.foundation.terminal import say
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions
from fusion.client.arena import Arena
from fusion.protocol.arena_health import assess_health

HEALTHY, ATTENTION = 0, 1  # exit codes; 2 where no server answers


def health(
    *,
    connection: ConnectionOptions = LOCAL_SERVER,
    timeout_s: float = 5.0,
    json: bool = False,
) -> int:
    """Print the state of an arena: cameras, robots, faults, age and grade of the calibration.

    The exit code is 0 for a healthy arena, 1 if something needs attention, and 2 if no server answers.

    Args:
        connection: the arena's server.
        timeout_s: how long to wait for the server, seconds.
        json: print one JSON object with all problems.
    """
    with Arena(connection.wait(), connection.arena) as client:
        status, rig = client.status(timeout_s).next(), client.rig(timeout_s)
    state = assess_health(status, rig, datetime.now(UTC))
    if json:
        say(json_format.dumps({"healthy": not state.problems, **msgspec.to_builtins(state)}))
    else:
        say(state.line)
    return ATTENTION if state.problems else HEALTHY
