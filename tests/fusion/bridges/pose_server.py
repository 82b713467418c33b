# SPDX-License-Identifier: BSD-3-Clause
"""A Zenoh router that publishes the poses of moving robots as a server does, and bridges that run as programs."""

import contextlib
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence

import msgspec
import numpy as np
import zenoh

from camera_node.geometry.pose import rotation_from_vector, wxyz_from_rotation
from camera_node.protocol.messages import ClockReply, Keys, encode
from camera_node.protocol.session import open_router
from fusion.model.limits import Limits
from fusion.protocol.pose_messages import FusionStatus, RobotPose, RobotPoses
from tests.conftest import ROOT
from tests.messages import STATUS
from tests.processes import first_line, killed_at_end, running
from tests.waiting import DEADLINE_S, wait_for

START_S = (
    0.5  # at least, of a server; a router that opens within 0.1 s of another's end learns no subscribers
)
ARENA = "test"
RATE_HZ = 50.0


def moving_pose(robot: str, t_ns: int, seed: int = 1, state: str = "tracked") -> RobotPose:
    """The pose at a time of a robot that circles, climbs and turns about a tilted axis; its velocities are exact."""
    rng = np.random.default_rng(seed)
    t, centre, axis = t_ns % 10**12 * 1e-9, rng.normal(size=3), rng.normal(size=3) / 2
    start = rotation_from_vector(rng.normal(size=3))
    A = rng.normal(size=(12, 12)) * 1e-3
    circle = np.array([np.cos(t), np.sin(t), 0.2 * np.sin(2 * t)])
    return RobotPose(
        robot=robot,
        t_ns=t_ns,
        state=state,  # pyright: ignore[reportArgumentType]: one of the three
        position=tuple((centre + circle).tolist()),
        quaternion_wxyz=tuple(wxyz_from_rotation(rotation_from_vector(axis * t) @ start).tolist()),
        velocity=(float(-np.sin(t)), float(np.cos(t)), float(0.4 * np.cos(2 * t))),
        angular_velocity=tuple(axis.tolist()),
        covariance=(A @ A.T).astype("<f4").tobytes(),
        n_markers=3,
        acceleration_density=(1.0, 1.0),
    )


def status(t_ns: int, limits: Limits) -> FusionStatus:
    """The status of a server without cameras."""
    return msgspec.structs.replace(STATUS, t_ns=t_ns, frame_sets_per_s=RATE_HZ, limits=limits)


def publish_poses(session: zenoh.Session, poses: Sequence[RobotPose]) -> None:
    """Publish poses as a server does: all in one message, and each on the key of its robot."""
    encoded = {Keys(ARENA).robot_pose(pose.robot): encode(pose) for pose in poses}
    session.put(Keys(ARENA).poses, RobotPoses.join(tuple(encoded.values())))
    for key, data in encoded.items():
        session.put(key, data)


class PoseServer:
    """Publishes `robots` with `RATE_HZ` and a lost robot, from `start` to `stop`; a context manager that does both.

    Args:
        endpoint: to listen on.
        robots: the names of those that are tracked.
        ahead_ns: the server's time minus this machine's.
        lateness_ms: of the limits in its status: poses that are older by that are passed on by bridges. A busy machine
            delays a bridge by seconds, and only tests of too old poses give the server's own.

    Attributes:
        published: all poses, by robot and time.
    """

    def __init__(
        self,
        endpoint: str,
        robots: tuple[str, ...] = ("rover", "drone"),
        ahead_ns: int = 0,
        lateness_ms: float = 1e3 * DEADLINE_S,
    ) -> None:
        self.endpoint, self.robots, self._ahead_ns = endpoint, robots, ahead_ns
        self._limits = Limits(lateness_ms=lateness_ms)
        self.published: dict[tuple[str, int], RobotPose] = {}
        self._keys = Keys(ARENA)

    def __enter__(self) -> "PoseServer":
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def start(self) -> None:
        """Open the router and begin to publish."""
        self._stopped = threading.Event()
        self.session = open_router([self.endpoint])
        self.session.declare_queryable(self._keys.clock, self._answer)
        self._thread = threading.Thread(target=self._run, args=(self.session,))
        self._thread.start()

    def stop(self) -> None:
        """End as a killed server does: nothing is published any more, and the connections are gone."""
        self._stopped.set()
        self._thread.join(DEADLINE_S)
        self.session.close()

    def now_ns(self) -> int:
        """The server's time."""
        return time.time_ns() + self._ahead_ns

    def _answer(self, query: zenoh.Query) -> None:
        query.reply(query.key_expr, encode(ClockReply(t_ns=self.now_ns())))

    def _run(self, session: zenoh.Session) -> None:
        while not self._stopped.wait(1 / RATE_HZ):
            t_ns = self.now_ns()
            session.put(self._keys.fusion_status, encode(status(t_ns, self._limits)))
            for seed, robot in enumerate((*self.robots, "gone")):
                pose = moving_pose(robot, t_ns, seed, "lost" if robot == "gone" else "tracked")
                self.published[robot, t_ns] = pose
            publish_poses(session, [self.published[robot, t_ns] for robot in (*self.robots, "gone")])


def bridge(command: str, *options: str) -> contextlib.AbstractContextManager[subprocess.Popen[str]]:
    """`python -m fusion COMMAND` in a process, ended by SIGTERM; it must end with exit code 0."""
    return running("fusion", command, "--arena", ARENA, *options, stdout=subprocess.PIPE, text=True)


def restart(server: PoseServer) -> int:
    """Restart the server; the time after which its new poses are."""
    server.stop()
    t_ns = server.now_ns()
    wait_for(lambda: server.now_ns() > t_ns + START_S * 1e9)
    server.start()
    wait_for(lambda: max(t for _, t in server.published) > t_ns)
    return t_ns


def main(endpoint: str, lateness_ms: str) -> None:
    """Serve the rover until the process is killed, and print a line once its poses are published."""
    with PoseServer(endpoint, ("rover",), lateness_ms=float(lateness_ms)) as server:
        wait_for(lambda: server.published)
        print("publishes", flush=True)
        threading.Event().wait()


@contextlib.contextmanager
def server_process(
    endpoint: str, lateness_ms: float = Limits().lateness_ms
) -> Iterator[subprocess.Popen[str]]:
    """A `PoseServer` of the rover in a process of its own, to be killed; it publishes."""
    words = [sys.executable, "-m", "tests.fusion.bridges.pose_server", endpoint, str(lateness_ms)]
    with killed_at_end(words, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        first_line(process)
        yield process


if __name__ == "__main__":
    main(*sys.argv[1:])
