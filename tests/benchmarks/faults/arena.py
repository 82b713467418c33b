# SPDX-License-Identifier: BSD-3-Clause
"""An arena of real programs: server, cameras, viewer, recorder and client, whose robots are simulated."""

import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import msgspec

from calib.rig.camera import Camera
from calib.rig.rig import Rig, save_rig
from camera_node.protocol.messages import CameraStatus, Keys, MessageError, decode
from fusion.client.arena import Arena as Client
from fusion.model.robots import Robot, save_robots
from fusion.protocol.pose_messages import FusionStatus
from tests.benchmarks.faults.camera import displaced
from tests.benchmarks.faults.judge import PoseJudge
from tests.benchmarks.faults.network import Loopback
from tests.benchmarks.faults.programs import Programs, python
from tests.benchmarks.faults.world import CameraCommand, CameraFault, Clock, RobotEvent, World
from tests.benchmarks.fusion_load import Load
from tests.conftest import ROOT, free_port

ARENA = "faults"
START_S = 60.0  # within which the arena must run, on a busy machine
RENDERED = "north"  # the camera of the demo's scene that a real node renders; the rig does not contain it
RENDERED_FPS = 5.0


@dataclass(frozen=True)
class Fuzz:
    """The options of the program `fuzzer`."""

    messages: int = 1000
    rate: float = 2000.0
    seed: int = 1
    only: str = ""


class LiveArena:
    """A running arena; a context manager. The poses of its robots are judged as they arrive.

    Args:
        folder: for the arena's files and logs.
        load: robots and cameras.
        extra: programs besides server and cameras: viewer, page, recorder, listener, bridge, rendered.
        network: where the programs run.
        rig: the server's calibration, if it is not the true one.
        robots: the server's robots, if they are not the true ones.
        judge: the class that judges poses.

    Attributes:
        rig: the cameras that the server's file has; more may be added before entry.
    """

    def __init__(
        self,
        folder: Path,
        load: Load,
        extra: Sequence[str] = (),
        network: Loopback | None = None,
        rig: Rig | None = None,
        robots: dict[str, Robot] | None = None,
        judge: type[PoseJudge] = PoseJudge,
    ) -> None:
        self.folder, self.load, self.extra = folder, load, extra
        self.network = network or Loopback()
        self.rig = dict(load.rig if rig is None else rig.cameras)
        self._robots = load.bodies if robots is None else robots
        self.clock = Clock()
        self.world = World(load, self.clock.now_ns())
        self.judge = judge(self.world)
        self.keys = Keys(ARENA)
        self.cameras = tuple(load.rig)
        self.endpoint = f"tcp/{self.network.host}:{free_port()}"
        self.page_port = free_port()
        self.status: FusionStatus | None = None
        self.camera_status: dict[str, CameraStatus] = {}
        self.camera_faults = {name: CameraFault() for name in self.cameras}
        self._pause = threading.Event()
        self._stack = ExitStack()
        self._recordings = 0
        self.fuzz = Fuzz()

    def __enter__(self) -> "LiveArena":
        with self._stack as stack:
            self._write_files()
            self.programs = stack.enter_context(Programs(self.folder))
            self.start("server")
            for name in (*self.cameras, *self.extra):
                self.start(name)
            self.client = stack.enter_context(Client.connect(self.endpoint, arena=ARENA))
            self.client.poses().on_message(self.judge.receive)
            self.client.status().on_message(lambda status: setattr(self, "status", status))
            self.session = self.client.session
            subscriber = self.session.declare_subscriber(self.keys.camera_status(), self._take_camera_status)
            stack.callback(subscriber.undeclare)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    def new_lines(self) -> list[tuple[str, str]]:
        """The lines that the programs logged since the last call, with the programs' names."""
        return self.programs.new_lines()

    def inspect(self, samples_memory: bool) -> None:
        """Note programs that ended by themselves, and the memory of all."""
        self.programs.check()
        if samples_memory:
            self.programs.sample_memory()

    def wait(self, seconds: float) -> None:
        """Wait; the arena goes on."""
        self._pause.wait(seconds)

    def wait_until_tracked(self, timeout_s: float = START_S) -> float:
        """Wait until all robots are tracked; return the seconds that took.

        Raises:
            TimeoutError: they are not.
        """
        begun_s = time.monotonic()
        while self.judge.tracked(0.5) < len(self.world.names):
            if time.monotonic() - begun_s > timeout_s:
                raise TimeoutError(f"{self.judge.tracked(0.5)} of {len(self.world.names)} robots are tracked")
            self.wait(0.01)
        return time.monotonic() - begun_s

    def wait_until_running(self) -> None:
        """Wait until the server reports itself and all cameras.

        Raises:
            TimeoutError: it does not.
        """
        begun_s = time.monotonic()
        while self.status is None or set(self.status.cameras) < set(self.cameras):
            if time.monotonic() - begun_s > START_S:
                raise TimeoutError("the server does not report all cameras")
            self.wait(0.01)

    def used_cameras(self) -> dict[str, Camera]:
        """The cameras as the server uses them."""
        rig = self.client.rig()
        assert rig is not None  # the arena has one
        return rig.cameras

    def true_camera(self, name: str) -> Camera:
        """A camera as it is by its faults."""
        return displaced(self.load.rig[name], self.camera_faults[name])

    def start(self, name: str) -> None:
        """Start a program, also again after its end."""
        command = self._camera(name) if name in self.cameras else getattr(self, f"_{name}")()
        self.programs.start(name, self.network.command(name, command), name == "fuzzer")
        if name in self.cameras:
            self.place(name, self.camera_faults[name])
            for event in self.world.events.values():
                self._command(name, CameraCommand(event=event))

    def start_twin(self, camera: str, view: str, name: str) -> None:
        """Start another node with the name of a camera, at the place of the camera `view`."""
        command = [*self._camera(camera), "--view", view]
        self.programs.start(name, self.network.command(name, command))

    def start_recorder_on_full_disk(self, free_bytes: int) -> None:
        """Start the recorder with a limit on the size of its file."""
        self.programs.start("recorder", ["prlimit", f"--fsize={free_bytes}", *self._recorder()], ends=True)

    def place(self, camera: str, fault: CameraFault) -> None:
        """Give a camera other faults."""
        self.camera_faults[camera] = fault
        self._command(camera, CameraCommand(fault=fault))

    def cover(self, event: RobotEvent) -> None:
        """Cover a robot for a while."""
        self.world.events[event.robot] = event
        for camera in self.cameras:
            self._command(camera, CameraCommand(event=event))

    def _command(self, camera: str, command: CameraCommand) -> None:
        self.programs.write(camera, msgspec.json.encode(command))

    def _take_camera_status(self, sample) -> None:
        try:
            status = decode(sample.payload.to_bytes(), CameraStatus)
        except MessageError:
            return
        if sample.key_expr == self.keys.camera_status(status.camera):
            self.camera_status[status.camera] = status

    # The command lines of the programs.

    def _server(self) -> list[str]:
        return python("fusion", "--config", self.folder / "arena.yaml")

    def _camera(self, name: str) -> list[str]:
        load = msgspec.json.encode(self.load).decode()
        place = ("--connect", self.endpoint, "--arena", ARENA, "--epoch-ns", self.world.epoch_ns)
        return python("tests.benchmarks.faults.camera", "--name", name, *place, "--load", load)

    def _viewer(self) -> list[str]:
        return python("web", "--headless", "--connect", self.endpoint, "--arena", ARENA)

    def _page(self) -> list[str]:
        return python("web", "--port", self.page_port, "--connect", self.endpoint, "--arena", ARENA)

    def _recorder(self) -> list[str]:
        self._recordings += 1
        out = self.folder / f"recording-{self._recordings}.mcap"
        return python("fusion", "record", out, "--connect", self.endpoint, "--arena", ARENA)

    def _fuzzer(self) -> list[str]:
        options = ("--messages", self.fuzz.messages, "--rate", self.fuzz.rate, "--seed", self.fuzz.seed)
        options += ("--only", self.fuzz.only) if self.fuzz.only else ()
        return python(
            "tests.benchmarks.faults.fuzzer", "--connect", self.endpoint, "--arena", ARENA, *options
        )

    def _listener(self) -> list[str]:
        return python("tests.benchmarks.faults.listener", "--connect", self.endpoint, "--arena", ARENA)

    def _bridge(self) -> list[str]:
        return python("fusion", "ros2", "--connect", self.endpoint, "--arena", ARENA)

    def _rendered(self) -> list[str]:
        sim = ("--source", "sim", "--scene", self.folder / "demo" / "scene.yaml", "--name", RENDERED)
        return python("camera_node", *sim, "--connect", self.endpoint, "--arena", ARENA)

    def _write_files(self) -> None:
        folder = self.folder
        save_rig(Rig(cameras=self.rig), folder / "rig.yaml")
        save_robots(self._robots, folder / "robots.yaml")
        files = {"rig": "rig.yaml", "saved_rig": "saved_rig.yaml", "robots": "robots.yaml"}
        files |= {"saved_robots": "saved_robots.yaml"}
        write(folder / "arena.yaml", {"arena": ARENA, "listen": [self.endpoint], **files})
        demo = ROOT / "configs" / "demo"
        scene = msgspec.yaml.decode((demo / "scene.yaml").read_bytes())
        scene["cameras"][RENDERED]["fps"] = RENDERED_FPS
        (folder / "demo").mkdir()
        write(folder / "demo" / "scene.yaml", scene)
        for path in demo.glob("*.yaml"):
            if path.name != "scene.yaml":
                (folder / "demo" / path.name).write_bytes(path.read_bytes())


def write(path: Path, data: object) -> None:
    """Write YAML."""
    path.write_bytes(msgspec.yaml.encode(data))


def small_load(robots: int = 10, cameras: int = 4) -> Load:
    """Ten robots that four cameras see at 30 Hz."""
    return Load(robots=robots, cameras=cameras, hz=30.0, speed_m_s=0.5)
