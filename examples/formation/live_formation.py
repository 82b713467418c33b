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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import zenoh

from camera_node.detection.detector import Detector
from camera_node.detection.relative_positions import DiscLocalizer
from camera_node.foundation.arrays import Array
from camera_node.foundation.errors import NetworkError, RoundelError
from camera_node.foundation.service import stopped_by_signals
from camera_node.foundation.supervisor import spawn, stop_all
from camera_node.foundation.terminal import say
from camera_node.geometry.pose import Pose
from camera_node.node.node import Node, NodeOptions
from camera_node.protocol.messages import RelativePositions, encode
from camera_node.protocol.session import listening_endpoints, open_router
from camera_node.simulation.floor import paint_floor
from camera_node.sources.frame import Frame, Source
from formation.formation_control import BLIND_S, Controller, Follower, Leader, place_of
from formation.formation_robots import (
    CAMERA,
    FPS,
    ROUNDEL,
    STANDSTILL,
    RobotCamera,
    RobotWorld,
    camera_matrix,
    compose,
    light,
    roundel_matrix,
)
from fusion.client import Arena
from web.errors import WebError
from web.state.feed import DemoProgress, progress_key

ARENA = "formation"
USUAL, ANY_PORT = "tcp/127.0.0.1:7447", "tcp/127.0.0.1:0"
START_S = 30.0  # limit for the nodes to start
TICK_S = 0.05
GRACE_S = 5.0
LEADER, LEFT, RIGHT = "leader", "left", "right"
SIDES = {LEFT: 1, RIGHT: -1}
START = np.array([1.0, 0.0, np.pi])  # of the leader in the world
START_ERROR = np.array([0.12, 0.12, 0.1])  # of the followers: standard deviations
RADIUS_M = 0.15  # of a robot
SETTLED_S = 5.0  # from the start; later distances count
LIMIT_M = 0.02
CLOSE_S = 20.0  # for a node to end, on a loaded machine
WAKE_S = 0.2  # between looks at whether a camera that waits is to end


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


def start_world(seed: int = 0) -> RobotWorld:
    """The robots at rest; the followers are near their places."""
    rng = np.random.default_rng(seed)
    poses = {LEADER: START}
    for name, side in SIDES.items():
        poses[name] = compose(START, place_of(side)) + START_ERROR * rng.standard_normal(3)
    return RobotWorld(poses, seed)


def controllers() -> dict[str, Controller]:
    """The control of each robot."""
    return {LEADER: Leader(), **{name: Follower(side) for name, side in SIDES.items()}}


def wanted_distances() -> dict[tuple[str, str], float]:
    """The distance of each pair of robots in formation, metres."""
    places = {LEADER: np.zeros(3)} | {name: place_of(side) for name, side in SIDES.items()}
    return {pair: _distance(places, pair) for pair in combinations(places, 2)}


@dataclass
class FormationScore:
    """Collects the distances of all pairs of robots; `errors_m` are those since `SETTLED_S`."""

    errors_m: dict[tuple[str, str], list[float]] = field(default_factory=dict)
    nearest_m: float = np.inf
    travelled_m: float = 0.0
    _last: Array | None = None

    def add(self, t_s: float, poses: Mapping[str, Array]) -> None:
        """Add the true poses (3,) of all robots at `t_s`."""
        for pair, wanted in wanted_distances().items():
            distance = _distance(poses, pair)
            self.nearest_m = min(self.nearest_m, distance)
            if t_s >= SETTLED_S:
                self.errors_m.setdefault(pair, []).append(distance - wanted)
        if self._last is not None:
            self.travelled_m += float(np.linalg.norm(poses[LEADER][:2] - self._last[:2]))
        self._last = poses[LEADER]

    @property
    def largest_error_m(self) -> float:
        """The largest error of a distance; 0 before any counts."""
        return max((abs(e) for errors in self.errors_m.values() for e in errors), default=0.0)

    def faults(self) -> list[str]:
        """What was not as it should be."""
        faults = []
        if self.nearest_m < 2 * RADIUS_M:
            faults.append(f"two robots collided: {self.nearest_m:.2f} m between their centres")
        if self.largest_error_m > LIMIT_M:
            faults.append(f"a distance was wrong by {1e3 * self.largest_error_m:.0f} mm")
        return faults

    def summarize(self) -> list[str]:
        """One line for each pair of robots."""
        lines = [
            f"the leader drove {self.travelled_m:.1f} m; no two robots came nearer than {self.nearest_m:.2f} m"
        ]
        for (a, b), wanted in wanted_distances().items():
            e = 1e3 * np.array(self.errors_m.get((a, b), []))
            if len(e):
                rms, most = np.sqrt(np.mean(e**2)), np.abs(e).max()
                lines.append(f"{a} - {b}: {wanted:.3f} m, error {rms:.1f} mm RMS, {most:.1f} mm at most")
        return lines


def _distance(poses: Mapping[str, Array], pair: tuple[str, str]) -> float:
    return float(np.linalg.norm(poses[pair[0]][:2] - poses[pair[1]][:2]))


class WorldClock:
    """Converts between Unix time, ns, and the world's time, s, which is 0 until `start`.

    Attributes:
        started: is set by `start`.
    """

    def __init__(self) -> None:
        self._start_ns = 0
        self.started = threading.Event()

    def start(self) -> None:
        """The world's time 0 is now."""
        self._start_ns = time.time_ns()
        self.started.set()

    def now_s(self) -> float:
        return self.seconds(time.time_ns()) if self.started.is_set() else 0.0

    def seconds(self, t_ns: int) -> float:
        return (t_ns - self._start_ns) * 1e-9

    def unix_ns(self, t_s: float) -> int:
        return self._start_ns + round(t_s * 1e9)


class RobotSource(Source):
    """The frames of a robot's camera in real time; a slow reader gets the newest exposure next.

    Args:
        world: the robots.
        camera: the robot's.
        clock: of the world.
        phase_s: time of the middle of the first exposure.

    Attributes:
        is_read: is set when the node begins to read frames; they come when the clock is started.
    """

    def __init__(self, world: RobotWorld, camera: RobotCamera, clock: WorldClock, phase_s: float) -> None:
        self.dropped = 0
        self._world, self._camera, self._clock, self._phase_s = world, camera, clock, phase_s
        self.is_read, self._closed = threading.Event(), threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        self.is_read.set()
        while not self._clock.started.wait(WAKE_S):
            if self._closed.is_set():
                return
        index = 0
        while self._wait_until(t_s := self._phase_s + index / FPS):
            self._world.advance(t_s)
            image = self._camera.capture(t_s, index)
            yield Frame(image, self._clock.unix_ns(t_s), CAMERA.exposure_us)
            newest = int((self._clock.now_s() - self._phase_s) * FPS)
            self.dropped += max(0, newest - index - 1)
            index = max(index + 1, newest)

    def close(self) -> None:
        """End the iteration, from any thread."""
        self._closed.set()

    def _wait_until(self, t_s: float) -> bool:
        """Wait until the end of the exposure around `t_s`; return whether the camera is still open."""
        end_s = t_s + CAMERA.exposure_us * 0.5e-6
        return not self._closed.wait(max(0.0, end_s - self._clock.now_s()))


class RobotDrive:
    """Gives a robot the commands of its control, for each message of its camera.

    Args:
        world: the robots.
        name: the robot's, and its camera's.
        controller: the robot's.
        clock: of the world.
    """

    def __init__(self, world: RobotWorld, name: str, controller: Controller, clock: WorldClock) -> None:
        self._world, self._name, self._controller, self._clock = world, name, controller, clock
        self._lock = threading.Lock()
        self._heard_s = 0.0
        self.n_messages = 0

    def receive(self, message: RelativePositions) -> None:
        """Take a message of the robot's camera."""
        t_s = self._clock.seconds(message.t_ns)
        with self._lock:
            seen, then = message.unpack(), self._world.at(self._name, t_s)
            self._controller.see(seen, t_s, then.odometry)
            self._heard_s = self._clock.now_s()
            self.n_messages += 1
            self._world.advance(self._heard_s)
            here = self._world.at(self._name, self._heard_s)
            self._world.drive(
                self._name, self._controller.command(self._heard_s, here.odometry), self._heard_s
            )

    def watch(self) -> None:
        """Stop the robot if its camera is silent; called several times a second."""
        with self._lock:
            now_s = self._clock.now_s()
            if now_s - self._heard_s > BLIND_S:
                self._world.drive(self._name, STANDSTILL, now_s)


class LiveRobot:
    """A robot's camera node in a thread, and its drive. `close` ends both.

    Args:
        name: the robot's.
        source: its camera.
        session: of the node; it stays open.
        drive: its control.
        arena: a client of the arena.
    """

    def __init__(
        self, name: str, source: RobotSource, session: zenoh.Session, drive: RobotDrive, arena: Arena
    ) -> None:
        localizer = DiscLocalizer(CAMERA, ROUNDEL.diameter_m)
        options = NodeOptions(arena.keys.arena, localizer=localizer, is_alone=True)
        self.drive, self.fault = drive, ""
        self._node = Node(name, source, Detector(), session, options)
        self._remove = arena.relative(name).on_message(drive.receive)
        self._thread = threading.Thread(target=self._run, name=f"robot {name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._remove()
        self._node.close()
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        try:
            self._node.run()
        except RoundelError as error:
            self.fault = str(error)


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
    floor, robots = paint_floor(0), []
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
