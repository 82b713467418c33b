# SPDX-License-Identifier: BSD-3-Clause
"""`roundel cameras`: lists, renames and forgets the cameras that registered, and shows what one of them refuses."""

from pathlib import Path
from typing import Literal

import msgspec

from camera_node.commands.adjust import save_picture
from camera_node.foundation.config import require_arguments, require_name
from camera_node.foundation.terminal import say
from camera_node.protocol.camera_requests import change_camera, request_cameras, request_snapshot
from camera_node.protocol.registration import CameraChange, RegisteredCamera
from camera_node.protocol.requests import RequestSource
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions

USES = {"list": "", "rename": "OLD NEW", "forget": "NAME", "why": "NAME [PICTURE.jpg]"}


def cameras(
    action: Literal["list", "rename", "forget", "why"] = "list",
    arguments: tuple[str, ...] = (),
    /,
    *,
    connection: ConnectionOptions = LOCAL_SERVER,
) -> int:
    """List, rename or forget the cameras of the running server, or save a picture of what one refuses, and why.

    Args:
        action: list; rename OLD NEW, in the rig too; forget NAME; why NAME [PICTURE.jpg].
        arguments: as the action needs them.
        connection: the arena's server.
    """
    if action == "rename" and len(arguments) == 2:
        require_name(arguments[1], "a camera")
    require_arguments("cameras", action, arguments, USES[action])
    with connection.open() as session:
        if action == "why":
            name = require_name(arguments[0], "a camera")
            out = Path(arguments[1] if len(arguments) > 1 else f"{name}_why.jpg")
            save_picture(request_snapshot(session, connection.arena, name, "why"), out)
            return 0
        registered = (
            request_cameras(session, connection.arena)
            if action == "list"
            else change_camera(session, connection.arena, _change(action, arguments))
        )
    if not registered:
        say("no camera is registered; roundel camera on its machine adds one")
    for name, camera in registered.items():
        say(_line(name, camera))
    return 0


def _change(action: str, arguments: tuple[str, ...]) -> CameraChange:
    name = arguments[1] if action == "rename" else ""
    source = RequestSource.of("roundel cameras")
    return CameraChange(camera=arguments[0], name=name, forget=action == "forget", source=source)


def _line(name: str, camera: RegisteredCamera) -> str:
    settings = msgspec.structs.asdict(camera.settings)
    given = [f"{key} {value}" for key, value in settings.items() if value is not None and key != "version"]
    return f"{name}: {camera.driver} {camera.source}{'; ' if given else ''}{', '.join(given)}"
