# SPDX-License-Identifier: BSD-3-Clause
"""An arena in virtual time: the server's own steps and the cameras of `SceneCamera`, without network and processes.

It causes the same faults of cameras and robots as `LiveArena`, repeatably and faster than real time. Faults of
programs need a `LiveArena`.
"""

import heapq
import logging
from pathlib import Path

import msgspec
import numpy as np

from calib.rig.camera import Camera
from calib.rig.rig import Rig, save_rig
from camera_node.protocol.messages import CameraStatus, Detections, Keys, decode, encode
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import FusionStatus, RobotPose
from fusion.server.arena_config import ArenaConfig
from fusion.server.server import Server
from fusion.tracking.tracker import Tracker
from tests.benchmarks.faults.camera import SceneCamera, SceneDetector
from tests.benchmarks.faults.judge import PoseJudge
from tests.benchmarks.faults.late_results import LateResults
from tests.benchmarks.faults.world import CameraFault, Clock, RobotEvent, World
from tests.benchmarks.fusion_load import START_NS, Load

ARENA = "virtual"
TICK_NS = 5_000_000  # between two looks of the server for frame sets that are due
TRANSIT_S = 0.002  # mean of the exponential distribution of a message's transit


class VirtualClock(Clock):
    """Time that only `VirtualArena.wait` advances."""

    def __init__(self) -> None:
        self.t_ns = START_NS

    def now_s(self) -> float:
        return self.t_ns * 1e-9

    def now_ns(self) -> int:
        return self.t_ns


class Outbox:
    """Takes what the server publishes: poses go to the judge.

    Attributes:
        received_ns: when the last message arrived.
    """

    def __init__(self, judge: PoseJudge) -> None:
        self._judge = judge
        self.received_ns = START_NS

    def publish(self, key: str, message: msgspec.Struct) -> None:
        """Judge a pose."""
        if isinstance(message, RobotPose):
            self._judge.receive(message)

    def put(self, key: str, data: bytes) -> None:
        """Judge poses that are encoded already; all poses of a moment in one message repeat them."""
        if key.endswith("/pose"):
            self._judge.receive(decode(data, RobotPose))


class VirtualArena:
    """Server, cameras and judge in virtual time; a context manager.

    Args:
        folder: for the server's files.
        load: robots and cameras.
        seed: of the transit of messages.
        rig: the server's calibration, if it is not the true one.
        robots: the server's robots, if they are not the true ones.
        judge: the class that judges poses.
        judging_s: how long a judgement of the cameras takes.

    Attributes:
        sources: the cameras by name.
    """

    def __init__(
        self,
        folder: Path,
        load: Load,
        seed: int = 1,
        rig: Rig | None = None,
        robots: dict[str, Robot] | None = None,
        judge: type[PoseJudge] = PoseJudge,
        judging_s: float = 0.0,
    ) -> None:
        self.load, self.clock = load, VirtualClock()
        self.world = World(load, START_NS)
        self.judge = judge(self.world, clock=self.clock)
        self._robots = load.bodies if robots is None else robots
        self.cameras = tuple(load.rig)
        self.status: FusionStatus | None = None
        self.camera_status: dict[str, CameraStatus] = {}
        self._rng, self._keys = np.random.default_rng(seed), Keys(ARENA)
        self.sources = {name: SceneCamera(self.world, name, SceneDetector()) for name in self.cameras}
        self._sent = dict.fromkeys(self.cameras, 0)
        self._due: list[tuple[int, str, int]] = []
        self._arrivals: list[tuple[int, str, int, bytes]] = []
        self._arrived_ns = dict.fromkeys(self.cameras, 0)
        self._tick_ns = START_NS
        self._log = _Lines()
        self._folder = folder
        self._judging = LateResults(judging_s, self.clock.now_s) if judging_s else None
        save_rig(rig or Rig(cameras=load.rig), folder / "rig.yaml")
        self.server = self._server()

    def __enter__(self) -> "VirtualArena":
        logging.getLogger("fusion").addHandler(self._log)
        for name, source in self.sources.items():
            self._schedule(name, source.next_after(-1, self.clock.t_ns))
        return self

    def __exit__(self, *exception: object) -> None:
        self.server.__exit__()
        logging.getLogger("fusion").removeHandler(self._log)

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        end_ns = self.clock.t_ns + round(seconds * 1e9)
        while (at_ns := min(self._tick_ns, self._due[0][0], self._next_arrival_ns())) < end_ns:
            self.clock.t_ns = max(self.clock.t_ns, at_ns)  # unless the server still works
            if self._due[0][0] <= self.clock.t_ns:
                self._deliver()
            elif at_ns == self._tick_ns:
                self._tick_ns += TICK_NS
                self._serve()
            else:
                self._receive()
        self.clock.t_ns = max(self.clock.t_ns, end_ns)

    @property
    def tracker(self) -> Tracker:
        """The server's."""
        assert self.server.pipeline.tracker is not None  # the arena has a rig
        return self.server.pipeline.tracker

    def place(self, camera: str, fault: CameraFault) -> None:
        """Give a camera other faults."""
        self.sources[camera].place(fault)

    def transit_s(self, name: str, rng: np.random.Generator) -> float:
        """How long the next message of a camera takes; messages of one camera stay in their order."""
        return rng.exponential(TRANSIT_S)

    def used_cameras(self) -> dict[str, Camera]:
        """The cameras as the server uses them."""
        return self.server.pipeline.cameras

    def true_camera(self, name: str) -> Camera:
        """A camera as it is by its faults."""
        return self.sources[name].true_camera

    def cover(self, event: RobotEvent) -> None:
        """Cover a robot for a while."""
        self.world.events[event.robot] = event

    def new_lines(self) -> list[tuple[str, str]]:
        """The lines that the server logged since the last call."""
        lines, self._log.lines = self._log.lines, []
        return [("server", line) for line in lines]

    def inspect(self, samples_memory: bool) -> None:
        """There are no programs that could end."""

    def restart(self) -> None:
        """Replace the server by one that knows only its files."""
        self.server.__exit__()
        self.server = self._server()

    def _server(self) -> Server:
        bodies = {name: msgspec.to_builtins(body) for name, body in self._robots.items()}
        rig, saved, robots = (str(self._folder / f"{file}.yaml") for file in ("rig", "saved_rig", "robots"))
        Path(robots).write_bytes(msgspec.yaml.encode({"robots": bodies}))
        server = Server(ArenaConfig(arena=ARENA, rig=rig, saved_rig=saved, robots=robots))
        server.clock = self.clock  # pyright: ignore[reportAttributeAccessIssue]
        self._outbox = Outbox(self.judge)
        server.transport = self._outbox  # pyright: ignore[reportAttributeAccessIssue]
        server.zones = None
        server.pipeline.judge_cameras_in(self._judging)
        return server

    def _schedule(self, name: str, seq: int) -> None:
        heapq.heappush(self._due, (self.sources[name].due_ns(seq), name, seq))

    def _deliver(self) -> None:
        """The next camera sends the frames that became available."""
        due_ns, name, seq = heapq.heappop(self._due)
        source, lens = self.sources[name], self.load.rig[name]
        for frame, roundels in source.deliver(seq):
            message = Detections.pack(
                roundels,
                camera=name,
                seq=self._sent[name],
                t_ns=frame.t_ns,
                sent_ns=frame.t_ns,
                width=lens.width,
                height=lens.height,
            )
            self._sent[name] += 1
            transit_ns = round(self.transit_s(name, self._rng) * 1e9)
            arrival_ns = max(self._arrived_ns[name] + 1, due_ns + transit_ns)
            self._arrived_ns[name] = arrival_ns
            heapq.heappush(self._arrivals, (arrival_ns, name, message.seq, encode(message)))
        self._schedule(name, source.next_after(seq, due_ns, source.fault.delay_ms))

    def _next_arrival_ns(self) -> int:
        return self._arrivals[0][0] if self._arrivals else self._tick_ns

    def _receive(self) -> None:
        arrival_ns, name, _, data = heapq.heappop(self._arrivals)
        self._outbox.received_ns = arrival_ns
        if self.clock.t_ns - arrival_ns <= self.server._max_lag_ns:
            self.server._receive_detections(data, self._keys.detections(name), arrival_ns)
        self._serve()

    def _serve(self) -> None:
        if self._judging is not None:
            self._judging.release()
        is_backlogged = bool(self._arrivals) and self._arrivals[0][0] < self.clock.t_ns
        self.server._fuse(self.clock.t_ns, is_backlogged)
        self.status = self.server._report_status(self.clock.t_ns) or self.status


class _Lines(logging.Handler):
    """Collects what the server logs."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())
