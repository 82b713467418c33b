# SPDX-License-Identifier: BSD-3-Clause
"""Decides which frames are admitted. They come from a network and may contain anything.

`admit` decides by the message and the rig alone, live and offline. `Ingest` is the live server's: it also refuses what
depends on earlier messages and on the time of arrival, and counts what is refused by its reason. Time and memory stay
bounded for any input.
"""

from collections import defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from calib.rig.camera import Camera
from camera_node.protocol.messages import Detections, Keys, MessageError, decode
from camera_node.protocol.publishers import HISTORY, Publishers
from fusion.model.frames import CalibratedFrame
from fusion.server.server_statistics import ServerStatistics

MAX_AGE_NS = 5_000_000_000  # a capture time older than this is implausible
MAX_AHEAD_NS = 2_000_000_000  # as is one so far in the future; `CameraClocks` corrects or refuses the others
MAX_UNCALIBRATED = 64  # cameras that the rig does not contain: more names are a fault of the publisher
MAX_BYTES = 1 << 19  # of a message; one with the most roundels has 240 kB
# Used of one frame: all markers of 200 robots; the others come from a texture or a fault.
MAX_DETECTIONS = 1024
# Of sequence numbers in the history, for two publishers that do not say who they are: a restarted node makes one.
MIN_STEPS_BACK = 4
ANOTHER_NODE = "frames of another node under its name"
Refusal = Literal["unknown camera", "wrong image size"]


def admit(
    message: Detections, cameras: Mapping[str, Camera], received_ns: int = 0
) -> CalibratedFrame | Refusal:
    """The calibrated frame of a message, or why it is refused.

    Args:
        message: of any camera.
        cameras: the placed cameras of the rig.
        received_ns: when it arrived; 0 offline.

    Returns:
        the frame with at most `MAX_DETECTIONS` detections.
    """
    if (refused := refusal(message, cameras)) is not None:
        return refused
    frame = CalibratedFrame.of(message, cameras[message.camera], received_ns)
    return _with_strongest(frame) if len(message) > MAX_DETECTIONS else frame


def refusal(message: Detections, cameras: Mapping[str, Camera]) -> Refusal | None:
    """Why `admit` refuses a message; None if it does not."""
    camera = cameras.get(message.camera)
    if camera is None:
        return "unknown camera"
    if (message.width, message.height) != (camera.width, camera.height):
        return "wrong image size"
    return None


@dataclass(slots=True)
class _FrameHistory:
    """The last sequence number of a camera, how many frames it sent, and which of them had a number that was not above
    the one before."""

    seq: int = -1
    n: int = 0
    steps_back: deque[int] = field(default_factory=lambda: deque(maxlen=MIN_STEPS_BACK))


class Ingest:
    """Decodes detections, and admits the frames of placed cameras.

    Args:
        keys: the arena's.
        statistics: counts what arrives and what is refused.
    """

    def __init__(self, keys: Keys, statistics: ServerStatistics) -> None:
        self._keys, self._statistics = keys, statistics
        self._histories = defaultdict[str, _FrameHistory](_FrameHistory)
        self._publishers = Publishers()
        self._calibrated: set[str] = set()
        self._uncalibrated: set[str] = set()

    def receive(
        self, data: bytes, key: str, received_ns: int, cameras: dict[str, Camera]
    ) -> CalibratedFrame | None:
        """The frame of a message, or None if it is refused.

        Args:
            data: the message.
            key: on which it arrived.
            received_ns: when it arrived.
            cameras: the placed ones.
        """
        message = self._decode(data, key, received_ns)
        if message is None:
            return None
        name, refused = message.camera, refusal(message, cameras)
        if not self._has_room(name, name in cameras):
            return self._refuse("too many cameras")
        if refused != "wrong image size" and not self._publishers.admits(message, received_ns):
            return self._refuse(ANOTHER_NODE, name)
        self._statistics.count_arrival(name, message.t_ns, received_ns)
        if refused is not None:
            return self._refuse(refused, name) if cameras else None
        if self._publishers.is_repeated(message):
            return self._refuse("duplicate frame", name)
        self._note_sequence(message)
        if len(message) > MAX_DETECTIONS:
            self._statistics.count_fault("frames with too many roundels", name)
        admitted = admit(message, cameras, received_ns)
        return admitted if isinstance(admitted, CalibratedFrame) else None

    def _decode(self, data: bytes, key: str, received_ns: int) -> Detections | None:
        """The message, if its content, its camera and its time are possible."""
        name = self._keys.camera_in(key)
        try:
            if len(data) > MAX_BYTES:
                raise MessageError("the message is too long")
            message = decode(data, Detections)
            if name != message.camera:
                raise MessageError("the key is another camera's")
        except MessageError:
            return self._refuse("undecodable detections", name)
        if not -MAX_AHEAD_NS <= received_ns - message.t_ns <= MAX_AGE_NS:
            return self._refuse("implausible time", name)
        return message

    def _refuse(self, reason: str, camera: str | None = None) -> None:
        self._statistics.count_refusal(reason, camera)

    def _has_room(self, name: str, is_calibrated: bool) -> bool:
        """Whether the camera is in the rig, or there is room for another one that is not."""
        if is_calibrated:
            self._calibrated.add(name)
            self._uncalibrated.discard(name)
        elif name not in self._calibrated and name not in self._uncalibrated:
            if len(self._uncalibrated) >= MAX_UNCALIBRATED:
                return False
            self._uncalibrated.add(name)
        return True

    def _note_sequence(self, message: Detections) -> None:
        """Report two publishers of one name: where nodes do not say who they are, sequence numbers that alternate show
        them."""
        history = self._histories[message.camera]
        history.n += 1
        if message.seq <= history.seq:
            history.steps_back.append(history.n)
        history.seq = message.seq
        alternates = len(history.steps_back) == MIN_STEPS_BACK and history.n - history.steps_back[0] < HISTORY
        has_two = alternates or self._publishers.is_contested(message.camera)
        self._statistics.note_publishers(message.camera, has_two)


def _with_strongest(frame: CalibratedFrame) -> CalibratedFrame:
    """The frame with the `MAX_DETECTIONS` detections of the highest contrast; those of textures have a low one."""
    contrast = np.nan_to_num(frame.roundels.contrast, nan=-np.inf, posinf=-np.inf)
    rows = np.sort(np.argpartition(-contrast, MAX_DETECTIONS)[:MAX_DETECTIONS])
    return frame.select(rows)
