# SPDX-License-Identifier: BSD-3-Clause
"""Two servers that are linked over the network: robots cross the border, then one server is killed."""

import time
from collections import defaultdict
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calib.rig.rig import Rig, save_rig
from camera_node.protocol.messages import decode
from fusion.model.limits import LimitSettings
from fusion.model.robots import save_robots
from fusion.protocol.pose_messages import Markers, RobotPose, Vector
from fusion.protocol.zone_messages import zone_key
from fusion.server.arena_config import ArenaConfig
from fusion.server.server import Server
from tests.fusion.serving import ServerProcess, connected, running_server, send, zones_of
from tests.fusion.synthetic import PERIOD_NS, START_NS, TRIANGLE, WIDE, Arena, Motion
from tests.fusion.zone_hall import hall, pairs
from tests.waiting import Inbox, wait_for

ROBOTS = {"near": TRIANGLE, "far": WIDE}
START: dict[str, Vector] = {"near": (3.9, 0.3, 0.2), "far": (4.4, -0.4, 0.2)}
END: dict[str, Vector] = {
    "near": (5.8, 0.3, 0.2),
    "far": (9.0, -0.4, 0.2),
}  # of which the west sees the first
PHASES = (0.0, 0.1, -0.15, 0.12, 0.05, -0.1, 0.17, -0.05)  # of the cameras
DRIVE_S = 2.0
N_WAITING, N_DRIVEN = 4, 75  # pictures of each camera; the waiting ones are repeated
AGE_NS = 1_500_000_000  # of the first pictures: those of a fast machine are not in the future
PACE_S = 0.5  # at most, until both servers have used a frame set
GAP_NS, AWAY_NS = 50_000_000, 1_000_000_000


def settings(folder: Path, endpoint: str) -> ArenaConfig:
    """Of both servers; frame sets wait until they are complete."""
    save_rig(Rig(cameras=hall(4)), folder / "rig.yaml")
    save_robots(ROBOTS, folder / "robots.yaml")
    return ArenaConfig(
        arena="test",
        listen=(endpoint,),
        rig=str(folder / "rig.yaml"),
        robots=str(folder / "robots.yaml"),
        limits=LimitSettings(lateness_ms=5000),
        zones=zones_of({"west": pairs(0, 1), "east": pairs(2, 3)}, endpoint),
        zone="west",
    )


class Show:
    """Cameras that take pictures of robots which wait, and then drive from the west to the east.

    All pictures are computed at first.

    Attributes:
        poses: of each robot, as a client receives them.
    """

    def __init__(self, server: Server) -> None:
        self._server, self._inbox = server, Inbox()
        motions = {name: drive(start, END[name]) for name, start in START.items()}
        arena = Arena(ROBOTS, motions, cameras=hall(4), phases=PHASES, sigma_px=0.05)
        messages = arena.messages(N_WAITING + N_DRIVEN)
        n = len(arena.cameras)
        self._sets = [messages[k : k + n] for k in range(0, len(messages), n)]
        self._is_driving, self._set, self._k = False, 0, 0
        self._begun_ns = time.time_ns() - AGE_NS
        self._done_ns = {"west": time.time_ns()}  # times of the last frame sets of servers that have any
        self.poses: dict[str, list[RobotPose]] = defaultdict(list)

    def take(self, pose: RobotPose) -> None:
        self.poses[pose.robot].append(pose)
        self._inbox.put(pose)

    def take_markers(self, zone: str, markers: Markers) -> None:
        """The markers of a frame set that a server has finished."""
        self._done_ns[zone] = markers.t_ns
        self._inbox.put(markers)

    def end(self, zone: str) -> None:
        """Do not wait for a server any more."""
        del self._done_ns[zone]

    def wait(self) -> None:
        """Send pictures of waiting robots; those that a busy machine would send late are skipped."""
        now_k = (time.time_ns() - AGE_NS - self._begun_ns) // PERIOD_NS
        self._k = now_k if (now_k - self._k) * PERIOD_NS > AGE_NS / 4 else self._k
        self._set = (self._set + 1) % N_WAITING
        self._send()

    def drive(self) -> None:
        """Send the next pictures of driving robots; at the end they wait."""
        self._set = min(max(self._set + 1, N_WAITING), len(self._sets) - 1)
        self._send()

    def _send(self) -> None:
        """Send a picture of each camera, then wait until both servers have used the ones before: on a busy machine, one
        would be far behind the other."""
        self._k += 1
        shift_ns = self._begun_ns + (self._k - self._set) * PERIOD_NS - START_NS
        stamped = [
            msgspec.structs.replace(m, t_ns=m.t_ns + shift_ns, sent_ns=m.t_ns + shift_ns, seq=self._k)
            for m in self._sets[self._set]
        ]
        send(self._server, stamped)
        before_ns = self._begun_ns + (self._k - 2) * PERIOD_NS
        self._inbox.until(lambda _: min(self._done_ns.values()) > before_ns, PACE_S)


def drive(start: Vector, end: Vector) -> Motion:
    """A motion that begins after the pictures of waiting robots."""

    def at(t: float) -> tuple[np.ndarray, np.ndarray]:
        s = np.clip((t - N_WAITING * PERIOD_NS * 1e-9) / DRIVE_S, 0.0, 1.0)
        return np.eye(3), np.array(start) + np.subtract(end, start) * (3 * s**2 - 2 * s**3)

    return at


def steps_ns(poses: list[RobotPose]) -> np.ndarray:
    """Between poses in the order of their times: on a busy machine, one server's may arrive before the other's."""
    return np.diff(sorted(pose.t_ns for pose in poses))


@pytest.mark.slow  # 8 s: two servers, and pictures at their pace
def test_two_servers_are_one_arena(tmp_path: Path, endpoint: str):
    """Two robots drive from the west to the east: each has one stream of poses, without a gap above 50 ms.
    Then the server of the east is killed: the west tracks the robot near the border on, and finds the other one with
    the cameras of the east within a second. Times are those of frames."""
    config = settings(tmp_path, endpoint)
    east = msgspec.structs.replace(config, listen=("tcp/127.0.0.1:0",), zone="east")
    with (
        Server(config) as west,
        running_server(west),
        connected(west) as client,
        ServerProcess(east) as other,
    ):
        show = Show(west)
        client.poses().on_message(show.take)
        client.markers().on_message(lambda markers: show.take_markers("west", markers))
        subscriber = client.session.declare_subscriber(
            zone_key("test", "markers", "east"),
            lambda sample: show.take_markers("east", decode(sample.payload.to_bytes(), Markers)),
        )
        assert west.zones is not None
        ownership = west.zones.member.ownership

        def are_followed() -> bool:
            show.wait()
            return all(ownership.owns(name) and ownership.followers(name) == ["east"] for name in ROBOTS)

        wait_for(are_followed, deadline_s=60)
        show.poses.clear()
        for _ in range(N_DRIVEN):
            show.drive()
        assert not any(map(ownership.owns, ROBOTS))
        for name, poses in show.poses.items():
            assert {pose.state for pose in poses} == {"tracked"}, name
            assert steps_ns(poses).min() > 0.2 * PERIOD_NS, "no two servers publish it at once"
            assert steps_ns(poses).max() < GAP_NS
        driven = {name: len(poses) for name, poses in show.poses.items()}
        other.kill()
        show.end("east")
        wait_for(lambda: show.drive() or all(map(ownership.owns, ROBOTS)), deadline_s=5)
        for _ in range(5):
            show.drive()
        for name, poses in show.poses.items():
            assert steps_ns(poses[driven[name] - 1 :]).max() < AWAY_NS
            assert poses[-1].state == "tracked"
            assert np.abs(np.subtract(poses[-1].position, END[name])).max() < 5e-3
        subscriber.undeclare()
