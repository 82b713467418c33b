# SPDX-License-Identifier: BSD-3-Clause
"""A hall with cameras along its length, and the servers of its zones in virtual time, without a network."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

from calib.rig.camera import Camera
from camera_node.geometry.pose import Pose, look_at
from camera_node.protocol.messages import decode, encode
from fusion.model.frames import CalibratedFrame
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import RobotPose
from fusion.protocol.zone_messages import ZoneReport, ZoneStates
from fusion.server.arena_config import Zone
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.server.zones.zone_member import ZoneMember
from fusion.tracking.tracker import Tracker

STEP_M, HALF_M = 3.0, 2.0  # between two pairs of cameras, and from the hall's axis to its walls
DELAY_NS, LATENCY_NS = 5_000_000, 2_000_000  # of frames, and of messages between servers


def hall(pairs: int) -> dict[str, Camera]:
    """Pairs of cameras on both walls, which look down at the axis; one pair sees the places of the next, not more."""
    lens = {"width": 800, "height": 600, "fx": 650.0, "fy": 651.0, "cx": 402.0, "cy": 297.0}
    return {
        f"{side}{k}": Camera(
            **lens, T_world_cam=Pose.from_matrix(look_at([STEP_M * k, y, 3.0], [STEP_M * k, y / 4, 0.0]))
        )
        for k in range(pairs)
        for side, y in (("n", HALF_M), ("s", -HALF_M))
    }


def pairs(*numbers: int) -> tuple[str, ...]:
    """The names of the cameras of these pairs."""
    return tuple(f"{side}{k}" for k in numbers for side in "ns")


@dataclass
class VirtualServer:
    """The server of a zone, and the poses that it published."""

    member: ZoneMember
    tracker: Tracker
    synchronizer: FrameSynchronizer
    poses: list[RobotPose] = field(default_factory=list)

    def take(self, frame: CalibratedFrame) -> None:
        """Take a frame, if the zone uses its camera."""
        if frame.camera in self.member.used_cameras:
            self.synchronizer.add(frame)

    def step(self, now_ns: int) -> list[tuple[str, bytes]]:
        """Track what is due; returns the keys and bytes of messages to other zones."""
        for frame_set in self.synchronizer.take(now_ns):
            self.member.begin(self.tracker.table, frame_set.t_ns)
            result = self.tracker.track(frame_set)
            self.poses += result.poses
            self.member.end(self.tracker.table, frame_set.t_ns)
        return [(key, encode(message)) for key, message in self.member.messages(now_ns)]

    def receive(self, zone: str, content: str, data: bytes) -> None:
        """Take a message of another zone."""
        if content == "report":
            self.member.ownership.receive(zone, decode(data, ZoneReport))
        elif content == f"states/{self.member.name}":
            self.tracker.table.receive(zone, decode(data, ZoneStates))


class VirtualHall:
    """The servers of all zones of an arena.

    Args:
        zones: the names of each zone's cameras.
        cameras: the placed ones.
        robots: by name.
        period_ns: of the cameras.
    """

    def __init__(
        self,
        zones: Mapping[str, tuple[str, ...]],
        cameras: dict[str, Camera],
        robots: dict[str, Robot],
        period_ns: int,
    ) -> None:
        described = [Zone(name=name, server="", cameras=names) for name, names in zones.items()]
        self.servers: dict[str, VirtualServer] = {}
        self._queue: list[tuple[int, str, str, bytes]] = []
        for name in zones:
            server = VirtualServer(
                ZoneMember("arena", described, name), Tracker(cameras, robots), FrameSynchronizer(period_ns)
            )
            server.member.set_cameras(cameras, robots)
            for other in self.servers.values():
                other.member.note_alive(name, True)
                server.member.note_alive(other.member.name, True)
            self.servers[name] = server

    def run(self, frames: Iterable[CalibratedFrame]) -> None:
        """Deliver frames in the order of their times, and the messages between them."""
        for frame in frames:
            now_ns = frame.t_ns + DELAY_NS
            due = [entry for entry in self._queue if entry[0] <= now_ns]
            self._queue = self._queue[len(due) :]
            for _, zone, content, data in due:
                for server in self.servers.values():
                    if server.member.name != zone:
                        server.receive(zone, content, data)
            for name, server in self.servers.items():
                server.take(frame)
                for key, data in server.step(now_ns):
                    self._queue.append((now_ns + LATENCY_NS, name, key.split("/", 4)[4], data))

    def kill(self, name: str) -> VirtualServer:
        """End a server; the others notice it at once."""
        for other in self.servers.values():
            if other.member.name != name:
                other.member.note_alive(name, False)
        return self.servers.pop(name)

    def streams(self, *dead: VirtualServer) -> dict[str, list[tuple[str, RobotPose]]]:
        """Of each robot the poses of all servers in the order of their times, with the zones that published them."""
        streams: dict[str, list[tuple[str, RobotPose]]] = defaultdict(list)
        for server in (*self.servers.values(), *dead):
            for pose in server.poses:
                streams[pose.robot].append((server.member.name, pose))
        for stream in streams.values():
            stream.sort(key=lambda entry: entry[1].t_ns)
        return streams


def changes(stream: list[tuple[str, RobotPose]]) -> int:
    """How often another zone publishes the next pose."""
    return sum(a[0] != b[0] for a, b in pairwise(stream))
