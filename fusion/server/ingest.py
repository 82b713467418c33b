# SPDX-License-Identifier: BSD-3-Clause
"""What cameras send, judged before it is used: it comes from a network, and may be anything.

What can't be used is counted by its reason. Whatever comes, time and memory stay bounded.
"""

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from calib.rig.camera import Camera
from camera_node.detection.roundels import Roundels
from camera_node.protocol.messages import Detections, Keys, MessageError, decode
from fusion.model.frames import CalibratedFrame
from fusion.server.status import ServerStatistics

FAR_NS = 5_000_000_000  # a capture time so far before now is a fault
AHEAD_NS = 200_000_000  # and one so far after now: clocks are aligned to milliseconds
REMEMBERED = 64  # frames of a camera
STEPS_BACK = 4  # of a frame's number among those remembered, which one node that was restarted does not make
SIZES_PX = 0.5, 1e5  # of an outline's axes


@dataclass(slots=True)
class _Sender:
    """The last frames of a camera: their times, and whether each one's number was not above the last."""

    times: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    steps_back: deque[bool] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    seq: int = -1


class Ingest:
    """Turns messages into frames.

    Args:
        keys: the arena's.
        health: counts what is refused.
    """

    def __init__(self, keys: Keys, health: ServerStatistics) -> None:
        self._keys, self._health = keys, health
        self._senders: dict[str, _Sender] = {}

    def receive(
        self, data: bytes, key: str, received_ns: int, cameras: dict[str, Camera]
    ) -> CalibratedFrame | None:
        """The frame of a message that a placed camera sent, or None."""
        try:
            message = decode(data, Detections)
            if key != self._keys.detections(message.camera):
                raise MessageError("of another camera than its key")
        except MessageError:
            return self._refuse("detections that are no message")
        if not -AHEAD_NS <= received_ns - message.t_ns <= FAR_NS:
            return self._refuse("implausible time")
        camera = cameras.get(message.camera)
        if not self._health.arrived(message.camera, message.t_ns, received_ns, camera is not None):
            return None
        if camera is None:
            return self._refuse("unknown camera") if cameras else None
        if (message.width, message.height) != (camera.width, camera.height):
            return self._refuse("wrong image size")
        if not self._is_new(message):
            return self._refuse("frame that came twice")
        frame = CalibratedFrame.of(message, camera, received_ns)
        return replace(frame, roundels=_plausible(frame.roundels))

    def _refuse(self, reason: str) -> None:
        self._health.count(reason)

    def _is_new(self, message: Detections) -> bool:
        """Whether the frame is not known yet. Two nodes of one name are noticed by numbers that go back and forth."""
        sender = self._senders.setdefault(message.camera, _Sender())
        if message.t_ns in sender.times:
            return False
        sender.times.append(message.t_ns)
        sender.steps_back.append(message.seq <= sender.seq)
        sender.seq = message.seq
        self._health.shared(message.camera, sum(sender.steps_back) >= STEPS_BACK)
        return True


def _plausible(roundels: Roundels) -> Roundels:
    """The roundels, of which no outline is told that can't be one."""
    low, high = SIZES_PX
    minor, major = roundels.axes_px[:, 1], roundels.axes_px[:, 0]
    good = (minor > low) & (minor <= major * 1.001) & (major < high) & np.isfinite(roundels.angle_rad)
    if good.all():
        return roundels
    axes, angle = (
        np.where(good[:, None], roundels.axes_px, np.nan),
        np.where(good, roundels.angle_rad, np.nan),
    )
    return replace(roundels, axes_px=axes, angle_rad=angle)
