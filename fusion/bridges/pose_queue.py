# SPDX-License-Identifier: BSD-3-Clause
"""What all bridges share: how they connect to an arena and receive its poses."""

import contextlib
import logging
import select
import socket
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence

from camera_node.protocol.server_connection import Connection
from fusion.client.arena import Arena
from fusion.protocol.pose_messages import RobotPose

log = logging.getLogger("fusion.bridge")

QUEUE_SIZE = 4096  # poses; four frame sets of 1024 robots
SILENCE_S = 5.0
WAIT_S = 0.2  # for poses, until a bridge looks whether it was stopped


class PoseQueue:
    """The poses of an arena, from Zenoh's thread to that of a bridge; a full queue loses its oldest poses.

    Logs when no pose arrives for `SILENCE_S`, and when poses arrive again: a bridge outlives its server.

    Args:
        client: connected to the arena.
        robot: of which poses are expected; None for all.

    Attributes:
        client: as given.
        faults: skipped poses, by reason.
    """

    def __init__(self, client: Arena, robot: str | None = None) -> None:
        self.client, self._robot = client, robot
        self.faults: Counter[str] = Counter()
        self._poses: deque[RobotPose] = deque(maxlen=QUEUE_SIZE)
        self._is_signaled = False
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)
        self._writer.setblocking(False)
        self._received_s, self._is_silent = time.monotonic(), False
        self._remove = client.pose_sets().on_message(self._put)

    def close(self) -> None:
        """Receive no more poses."""
        self._remove()
        self._reader.close()
        self._writer.close()

    def fileno(self) -> int:
        """A file descriptor that is readable while poses wait, for `select`."""
        return self._reader.fileno()

    def take(self, timeout_s: float = 0.0) -> list[RobotPose]:
        """All poses that wait, in order of arrival; the first one is waited for up to `timeout_s`."""
        if select.select([self._reader], [], [], timeout_s)[0]:
            with contextlib.suppress(BlockingIOError):
                self._reader.recv(64)
            self._is_signaled = False  # before the queue is emptied: a pose that arrives now signals again
        poses = [self._poses.popleft() for _ in range(len(self._poses))]
        self._report_silence(bool(poses))
        return poses

    def _report_silence(self, has_poses: bool) -> None:
        now_s = time.monotonic()
        if has_poses:
            if self._is_silent:
                log.info("receiving poses again")
            self._received_s, self._is_silent = now_s, False
        elif not self._is_silent and now_s - self._received_s >= SILENCE_S:
            self._is_silent = True
            cause = self.client.why_no_poses(self._robot)
            log.warning("no pose %s within %g s; %s", self.client.origin, SILENCE_S, cause)

    def _put(self, poses: Sequence[RobotPose]) -> None:
        if (excess := len(self._poses) + len(poses) - QUEUE_SIZE) > 0:
            self.faults["poses dropped because the bridge is too slow"] += excess
        self._poses.extend(poses)
        if not self._is_signaled:
            self._is_signaled = True
            with contextlib.suppress(BlockingIOError):
                self._writer.send(b"\0")


@contextlib.contextmanager
def receive_poses(connection: Connection, robot: str | None = None) -> Iterator[PoseQueue]:
    """The poses of all robots of an arena, or of one; what was skipped is logged at the end.

    Raises:
        NetworkError: an endpoint is invalid.
        ConfigError: the Zenoh configuration is missing or invalid.
    """
    with Arena(connection.wait(), connection.arena, robot or "*") as client:
        poses = PoseQueue(client, robot)
        try:
            yield poses
        finally:
            poses.close()
            log_faults(poses.faults + client.faults)


def log_faults(faults: Counter[str]) -> None:
    """Log what a bridge skipped."""
    for reason, count in faults.items():
        log.warning("%d %s", count, reason)
