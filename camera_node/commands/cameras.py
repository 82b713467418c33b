# SPDX-License-Identifier: BSD-3-Clause
"""`cameras`: lists, renames and forgets the cameras that registered; `settings` changes the settings of one."""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import tyro

from camera_node.errors import ConfigError
from camera_node.protocol.messages import MessageError, decode, encode
from camera_node.protocol.registration import (
    CameraChange,
    RegisteredCamera,
    RegisteredCameras,
    change_key,
    registered_key,
)
from camera_node.protocol.requests import RequestError, RequestSource, send_request
from camera_node.protocol.session import open_client
from camera_node.terminal import say

USES = {"list": "", "rename": "OLD NEW", "forget": "NAME"}
N_ARGUMENTS = {"list": 0, "rename": 2, "forget": 1}


def cameras(
    action: Literal["list", "rename", "forget"],
    arguments: tuple[str, ...] = (),
    /,
    *,
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",),
    arena: str = "arena",
    zenoh_config: Annotated[Path | None, tyro.conf.arg(name="zenoh")] = None,
) -> int:
    """List, rename or forget the cameras of the running server.

    Args:
        action: list; rename OLD NEW, in the rig too; forget NAME.
        arguments: as the action needs them.
        connect: the server's Zenoh endpoints.
        arena: the arena's name.
        zenoh_config: a Zenoh configuration (JSON5) for TLS, access control or scouting.
    """
    if len(arguments) != N_ARGUMENTS[action]:
        raise ConfigError(f"{len(arguments)} arguments; use roundel cameras {action} {USES[action]}".rstrip())
    with open_client(connect, zenoh_config) as session:
        if action == "list":
            reply = send_request(session, registered_key(arena))
        else:
            reply = send_request(session, change_key(arena), encode(_change(action, arguments)))
    for name, camera in _read(reply).cameras.items():
        say(_line(name, camera))
    return 0


def _change(action: str, arguments: tuple[str, ...]) -> CameraChange:
    name = arguments[1] if action == "rename" else ""
    change = CameraChange(
        camera=arguments[0],
        name=name,
        forget=action == "forget",
        source=RequestSource.of("roundel cameras"),
    )
    try:
        change.check()
    except MessageError as error:
        raise ConfigError(f"{' '.join(arguments)}: {error}") from None
    return change


def _read(data: bytes) -> RegisteredCameras:
    try:
        return decode(data, RegisteredCameras)
    except MessageError as error:
        raise RequestError(f"the server's reply is no list of cameras: {error}") from None


def _line(name: str, camera: RegisteredCamera) -> str:
    settings = msgspec.structs.asdict(camera.settings)
    given = [f"{key} {value}" for key, value in settings.items() if value is not None and key != "version"]
    return f"{name}: {camera.driver} {camera.source}{'; ' if given else ''}{', '.join(given)}"
