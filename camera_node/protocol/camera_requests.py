# SPDX-License-Identifier: BSD-3-Clause
"""Requests to a running camera node: its settings, its image, and a mask of what it detects."""

import queue

import numpy as np
import zenoh

from camera_node.arrays import Array
from camera_node.errors import NetworkError
from camera_node.protocol.messages import Detections, Keys, MessageError, Settings, decode, encode
from camera_node.protocol.requests import REQUEST_S, send_request

Polygon = tuple[tuple[float, float], ...]
MASK_MARGIN = 1.5  # radii of a reflection that a mask covers around its centre
MIN_MASK_PX = 12.0  # least radius of a mask around a detection
CORNERS = 8


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
        return decode(_ask(session, Keys(arena).settings(camera), payload, camera, timeout_s), Settings)
    except MessageError as error:
        raise NetworkError(f"the reply of camera {camera} has no settings: {error}") from None


def request_snapshot(
    session: zenoh.Session, arena: str, camera: str, draw: bool = False, timeout_s: float = REQUEST_S
) -> bytes:
    """A camera's current image as JPEG, in full size, with `draw` with the roundels drawn; raises as above."""
    key = Keys(arena).snapshot(camera) + ("?draw" if draw else "")
    return _ask(session, key, b"", camera, timeout_s)


def next_detections(
    session: zenoh.Session, arena: str, camera: str, timeout_s: float = REQUEST_S
) -> Detections:
    """The detections of the next frame of a camera. Raises NetworkError if no valid ones arrive in time."""
    arrived: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    key = Keys(arena).detections(camera)
    subscriber = session.declare_subscriber(key, lambda sample: arrived.put(sample.payload.to_bytes()))
    try:
        return decode(arrived.get(timeout=timeout_s), Detections)
    except (queue.Empty, MessageError) as error:
        reason = str(error) or f"no frame within {timeout_s:g} s"
        raise NetworkError(f"camera {camera} sent no detections: {reason}; check its program") from None
    finally:
        subscriber.undeclare()


def mask_of(detections: Detections) -> tuple[Polygon, ...]:
    """Polygons around all roundels of a frame, for reflections that look like roundels while none is in view."""
    roundels = detections.unpack()
    radii = np.maximum(MIN_MASK_PX, MASK_MARGIN * np.nan_to_num(roundels.axes_px[:, 0]) / 2)
    return tuple(_around(uv, radius) for uv, radius in zip(roundels.uv, radii, strict=True))


def _around(uv: Array, radius: float) -> Polygon:
    angle = 2 * np.pi * np.arange(CORNERS) / CORNERS
    corners = uv + radius / np.cos(np.pi / CORNERS) * np.column_stack([np.cos(angle), np.sin(angle)])
    return tuple((round(float(u), 1), round(float(v), 1)) for u, v in corners)


def _ask(session: zenoh.Session, key: str, payload: bytes, camera: str, timeout_s: float) -> bytes:
    try:
        return send_request(session, key, payload, timeout_s)
    except NetworkError:
        raise NetworkError(
            f"no camera '{camera}' answers within {timeout_s:g} s; check its name, and that its program runs"
        ) from None
