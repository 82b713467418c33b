# SPDX-License-Identifier: BSD-3-Clause
"""`fusion cameras`: lists, renames and forgets the cameras that registered, and changes their settings."""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import tyro

from camera_node.errors import ConfigError
from camera_node.protocol.messages import MessageError, Settings, decode, encode
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

USES = {"list": "", "rename": "OLD NEW", "forget": "NAME", "set": "NAME --exposure-us 4000"}
N_ARGUMENTS = {"list": 0, "rename": 2, "forget": 1, "set": 1}


def cameras(
    action: Literal["list", "rename", "forget", "set"],
    arguments: tuple[str, ...] = (),
    /,
    *,
    exposure_us: float | None = None,
    gain: float | None = None,
    mask: tuple[float, ...] | None = None,
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",),
    arena: str = "arena",
    zenoh_config: Annotated[Path | None, tyro.conf.arg(name="zenoh")] = None,
) -> int:
    """List, rename or forget the cameras of the running server, or change their settings.

    Args:
        action: list; rename OLD NEW, in the rig too; forget NAME; set NAME with one of the options below.
        arguments: as the action needs them.
        exposure_us: set: exposure time, microseconds.
        gain: set: gain, in the driver's units.
        mask: set: a polygon u v u v u v ..., pixels, in which roundels are ignored; without values, no mask.
        connect: the server's Zenoh endpoints.
        arena: the arena's name.
        zenoh_config: a Zenoh configuration (JSON5) for TLS, access control or scouting.
    """
    if len(arguments) != N_ARGUMENTS[action]:
        raise ConfigError(f"{len(arguments)} arguments; use roundel cameras {action} {USES[action]}".rstrip())
    settings = Settings(exposure_us=exposure_us, gain=gain, mask=_polygons(mask))
    if (settings == Settings()) == (action == "set"):
        raise ConfigError(
            "--exposure-us, --gain and --mask belong to roundel cameras set NAME, which needs one of them"
        )
    with open_client(connect, zenoh_config) as session:
        if action == "list":
            reply = send_request(session, registered_key(arena))
        else:
            reply = send_request(session, change_key(arena), encode(_change(action, arguments, settings)))
    for name, camera in _read(reply).cameras.items():
        say(_line(name, camera))
    return 0


def _change(action: str, arguments: tuple[str, ...], settings: Settings) -> CameraChange:
    name = arguments[1] if action == "rename" else ""
    change = CameraChange(
        camera=arguments[0],
        name=name,
        settings=settings,
        forget=action == "forget",
        source=RequestSource.of("roundel cameras"),
    )
    try:
        change.check()
    except MessageError as error:
        raise ConfigError(f"{' '.join(arguments)}: {error}") from None
    return change


def _polygons(mask: tuple[float, ...] | None) -> tuple[tuple[tuple[float, float], ...], ...] | None:
    """The value of `Settings.mask`: one polygon, or none."""
    if not mask:
        return None if mask is None else ()
    if len(mask) % 2 or len(mask) < 6:
        raise ConfigError(f"--mask has {len(mask)} numbers; give u and v of three corners or more")
    return (tuple(zip(mask[::2], mask[1::2], strict=True)),)


def _read(data: bytes) -> RegisteredCameras:
    try:
        return decode(data, RegisteredCameras)
    except MessageError as error:
        raise RequestError(f"the server's reply is no list of cameras: {error}") from None


def _line(name: str, camera: RegisteredCamera) -> str:
    settings = msgspec.structs.asdict(camera.settings)
    given = [f"{key} {value}" for key, value in settings.items() if value is not None and key != "version"]
    return f"{name}: {camera.driver} {camera.source}{'; ' if given else ''}{', '.join(given)}"
