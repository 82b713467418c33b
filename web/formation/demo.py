# SPDX-License-Identifier: BSD-3-Clause
"""`roundel demo --relative`: three simulated robots hold a formation by what their own cameras locate.

Everything but the robots, the light and the pictures is real: a camera node for each robot detects, locates and
publishes, and the robots' control receives `RelativePositions` over Zenoh. There is no server. Read `run_formation`
first.
"""

import contextlib
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence

import zenoh

from camera_node.foundation.errors import NetworkError
from camera_node.foundation.service import stopped_by_signals
from camera_node.foundation.supervisor import spawn, stop_all
from camera_node.foundation.terminal import say
from camera_node.geometry.pose import Pose
from camera_node.protocol.messages import encode
from camera_node.protocol.session import listening_endpoints, open_router
from fusion.client import Arena
from web.errors import WebError
from web.formation.formation import SETTLED_S, FormationScore, controllers, start_world
from web.formation.live import LiveRobot, RobotDrive, RobotSource, WorldClock
from web.formation.vision import FPS, RobotCamera, camera_matrix, light, paint_background, roundel_matrix
from web.formation.world import RobotWorld
from web.state.messages import DemoProgress, progress_key

ARENA = "formation"
USUAL, ANY_PORT = "tcp/127.0.0.1:7447", "tcp/127.0.0.1:0"
START_S = 30.0  # limit for the nodes to start
TICK_S = 0.05
GRACE_S = 5.0


def run_formation(
    listen: str | None, page: tuple[str, int] | None, seconds: float | None, seed: int = 0
) -> int:
    """Run the demo and return its exit code: 0 unless robots collided or left their distances.

    Args:
        listen: Zenoh endpoint of the robots' messages; None for port 7447, or a free one if that is taken.
        page: host and port of the viewer; None for no viewer.
        seconds: duration; None for no end before Ctrl-C.
        seed: of the robots' slip and odometry and of the floor.

    Raises:
        NetworkError: the endpoint is taken or invalid.
        WebError: the viewer ended.
    """
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(stopped_by_signals())
        router, endpoint = _open_router(listen)
        stack.callback(router.close)
        arena = stack.enter_context(Arena.connect(endpoint, arena=ARENA))
        viewer = stack.enter_context(_viewer(endpoint, page))
        world, clock = start_world(seed), WorldClock()
        robots = _start_robots(stack, router, arena, world, clock)
        clock.start()
        say(f"Zenoh endpoint of arena '{ARENA}': {endpoint}")
        score = _follow(stop, seconds, Progress(router, world, clock, robots), viewer)
    for line in score.summarize():
        say(line)
    return _conclude(score, robots, is_test=seconds is not None)


class Progress:
    """Scores the formation, reports it to terminal and page, and stops robots whose camera is silent."""

    def __init__(
        self, session: zenoh.Session, world: RobotWorld, clock: WorldClock, robots: Sequence[LiveRobot]
    ) -> None:
        self.score, self.robots = FormationScore(), robots
        self._session, self._world, self.clock = session, world, clock
        self._reported_s, self._counted = 0.0, 0

    def tick(self) -> None:
        """Called every `TICK_S`."""
        now_s = self.clock.now_s()
        if now_s <= 0:
            return
        for robot in self.robots:
            robot.drive.watch()
        self._world.advance(now_s)
        poses = {name: self._world.at(name, now_s).pose for name in self._world.names}
        self.score.add(now_s, poses)
        text = self._describe(now_s)
        points = {name: (tuple(roundel_matrix(pose)[:3, 3].tolist()),) for name, pose in poses.items()}
        cameras = {name: Pose.from_matrix(camera_matrix(pose)) for name, pose in poses.items()}
        progress = DemoProgress(
            t_ns=time.time_ns(), text=text, share=1.0, true_points=points, true_cameras=cameras
        )
        self._session.put(progress_key(ARENA), encode(progress))
        if now_s - self._reported_s >= 1.0:
            n = sum(robot.drive.n_messages for robot in self.robots)
            rate = (n - self._counted) / (now_s - self._reported_s) / len(self.robots)
            self._reported_s, self._counted = now_s, n
            say(f"{text}; {rate:.0f} of {FPS:.0f} frames/s")

    def _describe(self, now_s: float) -> str:
        brightness = f"light {100 * light(now_s, 0.0):.0f} %"
        if not self.score.errors_m:
            return f"{now_s:.0f} s: the robots take their places; {brightness}"
        errors = ", ".join(
            f"{a}-{b} {1e3 * values[-1]:+.1f}" for (a, b), values in self.score.errors_m.items()
        )
        return f"{now_s:.0f} s: errors of distances, mm: {errors}; {brightness}"


def _open_router(listen: str | None) -> tuple[zenoh.Session, str]:
    """The robots' Zenoh router and its endpoint."""
    if listen is None:
        try:
            return open_router([USUAL]), USUAL
        except NetworkError:
            listen = ANY_PORT
    router = open_router([listen])
    return router, listening_endpoints(router, [listen])[0]


def _start_robots(
    stack: contextlib.ExitStack, router: zenoh.Session, arena: Arena, world: RobotWorld, clock: WorldClock
) -> list[LiveRobot]:
    """Start all robots; their cameras are not synchronized."""
    floor, robots = paint_background(), []
    for k, (name, controller) in enumerate(controllers().items()):
        source = RobotSource(world, RobotCamera(world, name, floor), clock, k / (len(world.names) * FPS))
        drive = RobotDrive(world, name, controller, clock)
        robots.append(LiveRobot(name, source, router, drive, arena))
        stack.callback(robots[-1].close)
        if not source.is_read.wait(START_S):
            raise WebError(f"the camera node of {name} does not start; this machine may be overloaded")
    return robots


@contextlib.contextmanager
def _viewer(endpoint: str, page: tuple[str, int] | None) -> Iterator[subprocess.Popen | None]:
    """The viewer in a process of its own, which prints its address."""
    if page is None:
        yield None
        return
    host, port = page
    options = ["--connect", endpoint, "--arena", ARENA, "--host", host, "--port", str(port)]
    child = spawn("web", options)
    try:
        yield child
    finally:
        stop_all([child], GRACE_S)


def _follow(
    stop: threading.Event, seconds: float | None, progress: Progress, viewer: subprocess.Popen | None
) -> FormationScore:
    """Report until `stop`, or for some seconds."""
    while not stop.wait(TICK_S) and (seconds is None or progress.clock.now_s() < seconds):
        progress.tick()
        if viewer is not None and viewer.poll() is not None:
            raise WebError(f"the viewer ended with code {viewer.returncode}; --headless runs without it")
        if faults := [robot.fault for robot in progress.robots if robot.fault]:
            raise WebError(f"a robot's camera failed: {faults[0]}")
    return progress.score


def _conclude(score: FormationScore, robots: Sequence[LiveRobot], is_test: bool) -> int:
    """Print the last line and return the exit code; a demo that a user watched and ended did not fail."""
    faults = score.faults()
    if not score.errors_m:
        faults.append(f"it ended before {SETTLED_S:.0f} s, in which the robots take their places")
    if silent := sum(robot.drive.n_messages == 0 for robot in robots):
        faults.append(f"{silent} robots received no positions")
    if not faults:
        say("PASSED: no collision, and all distances within 2 cm")
        return 0
    say(f"{'FAILED' if is_test else 'ended'}: {'; '.join(faults)}")
    return int(is_test)
