# SPDX-License-Identifier: BSD-3-Clause
"""Messages that hold until the next one on their key, such as the rig: they begin each part of a recording."""

import contextlib

from calib.rig.rig_messages import RigMessage
from camera_node.protocol.messages import CameraStatus, MessageError, decode
from fusion.protocol.installation import Installation
from fusion.protocol.pose_messages import FusionStatus, Robots

INSTALLATION = "/recording"
# By the ends of their keys; the first end counts.
HELD = {
    "/rig": RigMessage,
    "/robots": Robots,
    "/fusion/status": FusionStatus,
    "/status": CameraStatus,
    INSTALLATION: Installation,
}


class Context:
    """The latest of these messages by key. What no reader can decode replaces none.

    Attributes:
        held: the messages by key.
    """

    def __init__(self) -> None:
        self.held: dict[str, bytes] = {}

    def add(self, key: str, data: bytes) -> None:
        """Take a message, which may be of any kind."""
        kind = next((kind for end, kind in HELD.items() if key.endswith(end)), None)
        if kind is not None:
            with contextlib.suppress(MessageError):
                decode(data, kind)
                self.held[key] = data
