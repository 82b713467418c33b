# SPDX-License-Identifier: BSD-3-Clause
"""`roundel history`, `roundel undo` and `roundel redo`: list the versions of the running server's rig, and step through
them."""

from datetime import datetime

import zenoh

from calib.live.rig_requests import request_rig, request_rig_history, step_rig
from calib.rig.file_history import Step
from calib.rig.rig_messages import RigVersion
from camera_node.foundation.errors import printable
from camera_node.foundation.terminal import say
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions
from fusion.model.corrections import corrected_cameras


def history(
    *,
    connection: ConnectionOptions = LOCAL_SERVER,
) -> int:
    """List the versions of the running server's rig, oldest first: when each was made, by whom, and what it changed.

    An undo restores the line above the one in force, a redo the line below.

    Args:
        connection: the arena's server.
    """
    with connection.open() as session:
        versions = request_rig_history(session, connection.arena).versions
    for version in versions:
        say(_line(version))
    if not versions:
        say("the server has no rig yet; calibrate with roundel calibrate wand --live")
    return 0


def _line(version: RigVersion) -> str:
    made = datetime.fromtimestamp(version.t_ns / 1e9).isoformat(" ", "seconds")
    by = version.source or version.unnamed_maker
    where = version.file or "in no file"
    text = f"{version.state:8}  {made}  {where}: {version.change or 'unknown change'}, by {by}"
    return printable(text)


def undo(
    *,
    connection: ConnectionOptions = LOCAL_SERVER,
) -> int:
    """Undo the last change of the running server's rig: a calibration, or its own correction of cameras.

    A camera whose recalibration is undone is no longer monitored, and a rig whose refinement is undone is not refined
    any more.

    Args:
        connection: the arena's server.
    """
    with connection.open() as session:
        say(_take(session, connection.arena, "undo"))
    return 0


def redo(
    *,
    connection: ConnectionOptions = LOCAL_SERVER,
) -> int:
    """Redo the change of the running server's rig that was undone last.

    Args:
        connection: the arena's server.
    """
    with connection.open() as session:
        say(_take(session, connection.arena, "redo"))
    return 0


def _take(session: zenoh.Session, arena: str, step: Step) -> str:
    """Change the server's rig; returns a sentence about the result."""
    before, history = request_rig(session, arena), request_rig_history(session, arena)
    after = step_rig(session, arena, step, f"roundel {step}", rig_t_ns=history.rig_t_ns).rig
    old = before.cameras if before else {}
    changed = [name for name in {**old, **after.cameras} if old.get(name) != after.cameras.get(name)]
    text = f"{history.describe_step(step)}; changed cameras: {', '.join(changed) or 'none'}"
    corrected = corrected_cameras(before, after) if step == "undo" and before else []
    if len(corrected) == 1:
        text += f"; {corrected[0]} is no longer monitored"
    elif corrected:
        text += "; the rig is not refined any more, until it is calibrated or the server starts again"
    return text
