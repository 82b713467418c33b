# SPDX-License-Identifier: BSD-3-Clause
"""The image sizes of the cameras that run."""

import threading

import zenoh

from camera_node.protocol.messages import CameraStatus, Keys, MessageError, decode
from camera_node.protocol.session import guarded

LISTEN_S = 2.5  # a camera publishes its status once a second
MAX_CAMERAS = 256


def running_camera_sizes(
    session: zenoh.Session, arena: str, seconds: float = LISTEN_S
) -> dict[str, tuple[int, int]]:
    """Width and height, pixels, of all cameras that publish their status within that time."""
    sizes: dict[str, tuple[int, int]] = {}
    key = Keys(arena).camera_status()

    def receive(sample: zenoh.Sample) -> None:
        try:
            status = decode(sample.payload.to_bytes(), CameraStatus)
        except MessageError:
            return
        if status.width > 0 and status.height > 0 and len(sizes) < MAX_CAMERAS:
            sizes[status.camera] = status.width, status.height

    subscriber = session.declare_subscriber(key, guarded(key, receive))
    threading.Event().wait(seconds)
    subscriber.undeclare()
    return dict(sizes)
