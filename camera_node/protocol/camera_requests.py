# SPDX-License-Identifier: BSD-3-Clause
"""Requests to a running camera node: its settings, its image, and its mask; and to the server: the cameras' names."""

import queue
from collections.abc import Sequence
from typing import Literal

import numpy as np
import zenoh
from numpy.typing import ArrayLike

from camera_node.foundation.arrays import Array
from camera_node.foundation.errors import ConfigError, NetworkError
from camera_node.protocol.messages import Detections, Keys, MessageError, Settings, decode, encode
from camera_node.protocol.presence import SILENT, why_no_camera
from camera_node.protocol.registration import (
    CameraChange,
    RegisteredCamera,
    RegisteredCameras,
    change_key,
    registered_key,
)
from camera_node.protocol.requests import REQUEST_S, RequestError, send_request

Polygon = tuple[tuple[float, float], ...]
MASK_MARGIN = 1.5  # radii of a reflection that a mask covers around its centre
MIN_MASK_PX = 12.0  # least radius of a mask around a detection
CORNERS = 8
MIN_MASK_AREA = 4.0  # square pixels of a polygon


def request_settings(
    session: zenoh.Session,
    arena: str,
    camera: str,
    wanted: Settings | None = None,
    timeout_s: float = REQUEST_S,
) -> Settings:
    """Change the settings of a camera that are not None, and return those in use; without `wanted`, change nothing.

    Raises:
        RequestError: the camera refuses a value; the message is the camera's.
        NetworkError: no camera of that name answers in time.
    """
    payload = encode(wanted) if wanted is not None else b""
    try:
        return decode(
            _ask(session, arena, camera, Keys(arena).settings(camera), payload, timeout_s), Settings
        )
    except MessageError as error:
        raise NetworkError(f"the reply of camera {camera} has no settings: {error}") from None


def request_snapshot(
    session: zenoh.Session,
    arena: str,
    camera: str,
    drawn: Literal["", "draw", "why"] = "",
    timeout_s: float = REQUEST_S,
) -> bytes:
    """A camera's current image as JPEG, in full size; raises as above.

    Args:
        session, arena, camera: which camera, and how it is reached.
        drawn: "draw" for the roundels, "why" for refused rings with their reasons too, empty for neither.
        timeout_s: longest time that the camera may take.
    """
    key = Keys(arena).snapshot(camera) + (f"?{drawn}" if drawn else "")
    return _ask(session, arena, camera, key, b"", timeout_s)


def next_detections(session: zenoh.Session, arena: str, camera: str) -> Detections:
    """The detections of the next frame of a camera. Raises NetworkError if no valid ones arrive in time."""
    arrived: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    key = Keys(arena).detections(camera)
    subscriber = session.declare_subscriber(key, lambda sample: arrived.put(sample.payload.to_bytes()))
    try:
        return decode(arrived.get(timeout=REQUEST_S), Detections)
    except (queue.Empty, MessageError) as error:
        reason = str(error) or f"no frame within {REQUEST_S:g} s"
        raise NetworkError(f"camera {camera} sent no detections: {reason}; check its program") from None
    finally:
        subscriber.undeclare()


def mask_of(detections: Detections) -> tuple[Polygon, ...]:
    """Polygons around all roundels of a frame, for reflections that look like roundels while none is in view."""
    roundels = detections.unpack()
    radii = np.maximum(MIN_MASK_PX, MASK_MARGIN * np.nan_to_num(roundels.axes_px[:, 0]) / 2)
    return tuple(_around(uv, radius) for uv, radius in zip(roundels.uv, radii, strict=True))


def mask_polygon(corners: Sequence[ArrayLike]) -> Polygon:
    """The polygon of `complete_corners` for a mask.

    Raises:
        ConfigError: there are fewer than two corners, or they enclose no area.
    """
    points = complete_corners(corners)
    if len(points) < 3 or not _area(points) >= MIN_MASK_AREA:
        raise ConfigError(
            "a mask needs two opposite corners of a rectangle, or three or more corners of a polygon, which enclose "
            f"{MIN_MASK_AREA:g} square pixels or more"
        )
    return tuple((round(float(u), 1), round(float(v), 1)) for u, v in points)


def complete_corners(corners: Sequence[ArrayLike]) -> Array:
    """The corners (N, 2) of a polygon, pixels: two are opposite corners of a rectangle, other numbers are all."""
    points = np.asarray(corners, float).reshape(-1, 2)
    if len(points) != 2:
        return points
    (u0, v0), (u1, v1) = points
    return np.array([(u0, v0), (u1, v0), (u1, v1), (u0, v1)])


def _area(points: Array) -> float:
    u, v = (points - points[0]).T
    return abs(float(u @ np.roll(v, -1) - v @ np.roll(u, -1))) / 2


def request_cameras(session: zenoh.Session, arena: str) -> dict[str, RegisteredCamera]:
    """All registered cameras by name. Raises RequestError for an invalid answer, NetworkError for none."""
    return _read_cameras(send_request(session, registered_key(arena)))


def change_camera(
    session: zenoh.Session, arena: str, change: CameraChange, timeout_s: float = REQUEST_S
) -> dict[str, RegisteredCamera]:
    """Have the server rename or forget a camera; returns and raises as `request_cameras`.

    Raises:
        ConfigError: no camera can have one of the names.
    """
    try:
        change.check()
    except MessageError as error:
        raise ConfigError(f"{change.camera} {change.name}".rstrip() + f": {error}") from None
    return _read_cameras(send_request(session, change_key(arena), encode(change), timeout_s))


def _read_cameras(data: bytes) -> dict[str, RegisteredCamera]:
    try:
        return decode(data, RegisteredCameras).cameras
    except MessageError as error:
        raise RequestError(f"the server's reply is no list of cameras: {error}") from None


def _around(uv: Array, radius: float) -> Polygon:
    angle = 2 * np.pi * np.arange(CORNERS) / CORNERS
    corners = uv + radius / np.cos(np.pi / CORNERS) * np.column_stack([np.cos(angle), np.sin(angle)])
    return tuple((round(float(u), 1), round(float(v), 1)) for u, v in corners)


def _ask(
    session: zenoh.Session, arena: str, camera: str, key: str, payload: bytes, timeout_s: float
) -> bytes:
    try:
        return send_request(session, key, payload, timeout_s)
    except NetworkError:
        cause = why_no_camera(session, Keys(arena).camera_alive(), camera) or SILENT
        raise NetworkError(f"camera '{camera}' does not answer within {timeout_s:g} s; {cause}") from None
