# SPDX-License-Identifier: BSD-3-Clause
"""What all bridges share: how they connect to an arena, receive its poses, and learn that a robot is lost."""

import contextlib
import logging
import select
import socket
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence

import msgspec

from camera_node.protocol.server_connection import Connection
from fusion.client.arena import Arena
from fusion.model.limits import Limits
from fusion.protocol.pose_messages import RobotPose

log = logging.getLogger("fusion.bridge")

QUEUE_SIZE = 4096  # poses; four frame sets of 1024 robots
SILENCE_S = 5.0
WAIT_S = 0.2  # for poses, until a bridge looks whether it was stopped


class PoseQueue:
    """The poses of an arena, from Zenoh's thread to that of a bridge; a full queue loses its oldest poses.

    A pose that is too old is not passed on. A robot whose newest pose becomes too old, because the server, the network
    or this machine stopped, is passed on once more, as `lost`. Too old is what the server itself would call lost: its
    `lost_after_s`, and `lateness_ms` that a frame set may wait.

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
        self._poses: deque[tuple[RobotPose, float]] = deque(maxlen=QUEUE_SIZE)  # and when each arrived
        self._located: dict[str, tuple[RobotPose, float]] = {}  # the newest of each robot that is not lost
        self._status = client.status()
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
        arrived = [self._poses.popleft() for _ in range(len(self._poses))]
        poses = self._recent(arrived)
        self._report_silence(bool(poses), bool(arrived))
        return poses + self._newly_lost()

    def _recent(self, arrived: Sequence[tuple[RobotPose, float]]) -> list[RobotPose]:
        """The poses that are not too old."""
        now, max_age_s, recent = self.client.time.read(), self._max_age_s(), []
        for pose, received_s in arrived:
            if now.age_s(pose.t_ns, received_s) > max_age_s:
                continue
            recent.append(pose)
            if pose.state == "lost":
                self._located.pop(pose.robot, None)
            else:
                self._located[pose.robot] = pose, received_s
        if old := len(arrived) - len(recent):
            self.faults["poses that were too old when the bridge took them"] += old
        return recent

    def _newly_lost(self) -> list[RobotPose]:
        """The last poses of robots of which no recent one is there, as those of lost robots; each once."""
        now, max_age_s = self.client.time.read(), self._max_age_s()
        old = {k: pose for k, (pose, at_s) in self._located.items() if now.age_s(pose.t_ns, at_s) > max_age_s}
        for robot in old:
            del self._located[robot]
        if old:
            names = ", ".join(sorted(old))
            log.warning("no pose of %s is younger than %.2f s: passed on as lost", names, max_age_s)
        return [msgspec.structs.replace(pose, state="lost") for pose in old.values()]

    def _max_age_s(self) -> float:
        status = self._status.latest()
        limits = (status and status.limits) or Limits()
        return limits.lost_after_s + limits.lateness_ms * 1e-3

    def _report_silence(self, has_poses: bool, has_old: bool) -> None:
        now_s = time.monotonic()
        if has_poses:
            if self._is_silent:
                log.info("receiving poses again")
            self._received_s, self._is_silent = now_s, False
        elif not self._is_silent and now_s - self._received_s >= SILENCE_S:
            self._is_silent = True
            cause = self.client.why_no_poses(self._robot)
            if has_old:
                cause = "those that arrive are too old: the network or this machine is too slow"
            log.warning("no pose %s within %g s; %s", self.client.origin, SILENCE_S, cause)

    def _put(self, poses: Sequence[RobotPose]) -> None:
        if (excess := len(self._poses) + len(poses) - QUEUE_SIZE) > 0:
            self.faults["poses dropped because the bridge is too slow"] += excess
        received_s = time.monotonic()
        self._poses.extend((pose, received_s) for pose in poses)
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
