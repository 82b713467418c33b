# SPDX-License-Identifier: BSD-3-Clause
"""Runs simulated robots in real time: each has a camera node, and its control receives what the node publishes."""

import threading
import time
from collections.abc import Iterator

import zenoh

from camera_node.detection.detector import Detector
from camera_node.detection.relative import DiscLocalizer
from camera_node.foundation.errors import RoundelError
from camera_node.node.node import Node, NodeOptions
from camera_node.protocol.messages import RelativePositions
from camera_node.sources.frame import Frame, Source
from fusion.client import Arena
from web.formation.control import BLIND_S, Controller
from web.formation.vision import CAMERA, FPS, ROUNDEL, RobotCamera
from web.formation.world import STANDSTILL, RobotWorld

CLOSE_S = 20.0  # for a node to end, on a loaded machine
WAKE_S = 0.2  # between looks at whether a camera that waits is to end


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
