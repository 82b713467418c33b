# SPDX-License-Identifier: BSD-3-Clause
"""Decides which frames count where several nodes publish under one camera's name, or one sends a frame twice."""

from collections import defaultdict, deque
from dataclasses import dataclass

from camera_node.protocol.messages import Detections

HANDOVER_NS = 1_000_000_000  # after the last frame of a name's owner, the name passes to another node
HISTORY = 64  # frames of a camera
# Two stamps of one frame, one after the other: a node adds the error of its clock by its newest estimate, so that those
# of a frame that its driver delivers twice differ by nanoseconds. Older stamps may come again: clocks are set back.
SAME_NS = 10_000


@dataclass(slots=True)
class _Owner:
    """The node whose frames count, and when its last frame and the last refused one arrived."""

    publisher: int
    last_ns: int
    refused_ns: int | None = None
    is_contested: bool = False


class Publishers:
    """A name has one publisher at a time: the first one, until it was silent for `HANDOVER_NS`.

    Nodes are distinguished by `Detections.publisher`; those that do not send it count as one.
    """

    def __init__(self) -> None:
        self._owners: dict[str, _Owner] = {}
        self._stamps: defaultdict[str, deque[int]] = defaultdict(lambda: deque(maxlen=HISTORY))  # by camera

    def admits(self, message: Detections, received_ns: int) -> bool:
        """Whether a frame is that of the owner of its camera's name, or of its successor.

        Args:
            message: of a camera that may be remembered.
            received_ns: when it arrived.
        """
        owner = self._owners.get(message.camera)
        if owner is None or (
            owner.publisher != message.publisher and abs(received_ns - owner.last_ns) > HANDOVER_NS
        ):
            self._owners[message.camera] = _Owner(message.publisher, received_ns)
            return True
        if owner.publisher != message.publisher:
            owner.refused_ns = received_ns
            return False
        owner.last_ns = received_ns
        owner.is_contested = (
            owner.refused_ns is not None and abs(received_ns - owner.refused_ns) <= HANDOVER_NS
        )
        return True

    def is_repeated(self, message: Detections) -> bool:
        """Whether an admitted frame came before; if not, its stamp is remembered."""
        stamps = self._stamps[message.camera]
        if message.t_ns in stamps or (stamps and abs(message.t_ns - stamps[-1]) < SAME_NS):
            return True
        stamps.append(message.t_ns)
        return False

    def is_contested(self, camera: str) -> bool:
        """Whether the owner sent a frame after one of another node: that is no successor, but a second node."""
        owner = self._owners.get(camera)
        return owner is not None and owner.is_contested
