# SPDX-License-Identifier: BSD-3-Clause
"""Runs a whole arena with simulated cameras: wand calibration, then tracking of robots, compared with the truth.

Read `Demo.run` first: it lists the steps.
"""

import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from calib.live.rig_requests import set_rig
from calib.rig.camera import Camera
from calib.rig.rig import Rig, load_rig, save_rig
from calib.world.world_frame import align_cameras
from camera_node.protocol.connection import ServerConnection
from camera_node.protocol.session import CONNECT_S
from camera_node.simulation.scene import Scene
from fusion.protocol.messages import RobotPose
from web.demo_progress import (
    ProgressReporter,
    SceneClock,
    describe_calibration_step,
    describe_errors,
    describe_tracking_step,
)
from web.demo_server import RunningServer, start_server
from web.feed import Feed
from web.page_access import PageAccess, is_loopback
from web.processes import Processes, ProgramFailed, interrupt_on_signals
from web.score import PoseScore, summarize
from web.subscription import Subscription
from web.usage import ResourceUsage

ARENA = "demo"
MIN_START_S = 3.0  # for the programs to start before the wand session
CALIBRATION_S = 90.0  # limit for the calibration after the wand session
SETTLE_S = 0.5  # after a new calibration, until no pose of the previous one arrives
ACQUISITION_S = 5.0  # for all robots to be acquired; a robot that is not tracked then counts as lost
TICK_S = 0.05


def run_demo(
    scene_path: Path, listen: str | None, page: tuple[str, int] | None, seconds: float | None
) -> int:
    """Run the demo and return its exit code: 0 if the poses are correct, 1 if not or if a program failed.

    Args:
        scene_path: a scene; arena.yaml, robots.yaml and wand.yaml are beside it.
        listen: the server's Zenoh endpoint; None for port 7447, or a free one if that is taken.
        page: host and port of the viewer; None for no viewer.
        seconds: duration of the tracking; None for no end before Ctrl-C.

    Raises:
        ConfigError, WebError: a file is invalid, or a port is taken.
    """
    scene = Scene.load(scene_path)
    folder = Path(tempfile.mkdtemp(prefix="roundel-demo-"))
    try:
        with interrupt_on_signals(), Processes(folder) as processes:
            server = start_server(processes, scene_path.parent / "arena.yaml", listen)
            code = Demo(scene, scene_path.parent, processes, server).run(page, seconds)
    except ProgramFailed as error:
        print(f"the demo failed: {error}", flush=True)
        return 1
    if code:
        print(f"the programs' logs are in {folder}", flush=True)
    else:
        shutil.rmtree(folder, ignore_errors=True)
    return code


def conclude(faults: list[str], is_test: bool) -> tuple[str, int]:
    """The last line of the demo and its exit code.

    A demo with `--seconds` is a test. One that a user watched and ended did not fail, whatever happened in its minutes.
    """
    if not faults:
        return "PASSED: all robots are within the limits", 0
    if is_test:
        return f"FAILED: {'; '.join(faults)}", 1
    return f"ended; beyond the limits at times: {'; '.join(faults)}", 0


def start_delay_s(n_programs: int, startup_s: float) -> float:
    """Return the time for programs to start at once on all processors, if one alone takes `startup_s`."""
    return max(MIN_START_S, startup_s * n_programs / (os.cpu_count() or 1))


class Demo:
    """Runs the steps of the demo beside a running server, and prints one line per second."""

    def __init__(self, scene: Scene, files: Path, processes: Processes, server: RunningServer) -> None:
        """Connect to the server.

        Args:
            scene: the simulated scene.
            files: folder with scene.yaml and wand.yaml.
            processes: runs the other programs.
            server: the server, which `processes` runs.
        """
        self.scene, self.files, self.processes, self.endpoint = scene, files, processes, server.endpoint
        self.connection = ServerConnection([self.endpoint])
        self.session = self.connection.session(CONNECT_S)
        self.delay_s = start_delay_s(len(scene.cameras) + 2, server.startup_s)  # cameras, page, calibration
        self.clock = SceneClock(scene, time.time_ns() + round(self.delay_s * 1e9))
        self.feed = Feed(ARENA, self._add_to_score)
        self.subscription = Subscription(self.connection, self.feed)
        self._reporter = ProgressReporter(self.session, ARENA, self.clock)
        self._score: PoseScore | None = None

    def run(self, page: tuple[str, int] | None, seconds: float | None) -> int:
        """Run all steps; return the exit code."""
        try:
            self._start_programs(page)
            self._wait_for_calibration()
            self._align_to_scene()
            self._wait_for_robots()
            return self._track_and_score(seconds)
        finally:
            self.subscription.close()
            self.connection.close()

    def _start_programs(self, page: tuple[str, int] | None) -> None:
        """Start the cameras, the viewer and the calibration."""
        folder, files, start = self.processes.folder, self.files, self.processes.start
        connect = ["--connect", self.endpoint, "--arena", ARENA]
        source = ["--source", "sim", "--scene", str(files / "scene.yaml")]
        for name in self.scene.cameras:
            epoch = ["--epoch-ns", str(self.clock.epoch_ns)]
            start(name, "camera_node", [*source, "--name", name, *epoch, *connect])
        if page is not None:
            self._start_page(*page, connect)
        print(f"Zenoh endpoint of arena '{ARENA}': {self.endpoint}", flush=True)
        intrinsics = {name: Camera(**entry) for name, entry in self.scene.rig_entries().items()}
        save_rig(Rig(cameras=intrinsics), folder / "intrinsics.yaml")
        wand = ["wand", "--live", "--wand", str(files / "wand.yaml")]
        duration = ["--seconds", str(self.delay_s + self.scene.wave_s)]
        rigs = ["--rig", str(folder / "intrinsics.yaml"), "--out", str(folder / "rig.yaml")]
        start("calib", "calib", [*wand, *duration, *rigs, *connect])

    def _start_page(self, host: str, port: int, connect: list[str]) -> None:
        """Start the viewer, with tokens that this process can print if other machines may open the page."""
        tokens = None if is_loopback(host) else self.processes.folder / "page_tokens.yaml"
        access = PageAccess.create(host, port, tokens)
        options = ["--tokens", str(tokens)] if tokens else []
        self.processes.start("web", "web", [*connect, "--host", host, "--port", str(port), *options])
        print(*access.instructions(), sep="\n", flush=True)

    def _wait_for_calibration(self) -> None:
        """Report the wand session until `calib` has calibrated the cameras."""
        for whole_second in self._ticks(self.delay_s + self.scene.wave_s + CALIBRATION_S):
            if self.processes.finished("calib"):
                return
            text = describe_calibration_step(self.clock, self.feed.state())
            self._reporter.report(text, self.clock.wand_share(), whole_second)
        raise ProgramFailed(f"the calibration did not end in time; the logs are in {self.processes.folder}")

    def _align_to_scene(self) -> None:
        """Align the calibration with the cameras' true positions: a wand does not define a world frame."""
        rig = load_rig(self.processes.folder / "rig.yaml")
        if missing := set(self.scene.cameras) - set(rig.placed()):
            raise ProgramFailed(f"the calibration has no pose for {', '.join(sorted(missing))}")
        positions = {name: self.scene.T_world_cam(name)[:3, 3] for name in self.scene.cameras}
        aligned, errors_m = align_cameras(rig, positions)
        set_rig(self.session, ARENA, aligned, "web --demo")
        error = f"position errors up to {1e3 * max(errors_m.values()):.2f} mm"
        print(f"calibrated: {len(errors_m)} cameras, {error}", flush=True)

    def _wait_for_robots(self) -> None:
        """Give the server time to acquire the robots."""
        score = self._score = self._new_score(time.time_ns() + round(SETTLE_S * 1e9))
        for _ in self._ticks(ACQUISITION_S):
            if score.all_tracked():
                break

    def _track_and_score(self, seconds: float | None) -> int:
        """Compare the poses with the truth, print the summary, and return the exit code."""
        usage = ResourceUsage(self.processes, self.feed)
        score = self._score = self._new_score(usage.start_ns)
        try:
            for whole_second in self._ticks(seconds):
                if whole_second:
                    self.processes.measure()
                    self._reporter.report(describe_errors(score), 1.0, print_text=False)
                    print(describe_tracking_step(score, usage, self.scene.cameras), flush=True)
        except KeyboardInterrupt:  # the user ended the demo and expects the summary
            print(flush=True)
        self._score = None
        results = score.results(usage.start_ns, time.time_ns())
        faults = [fault for result in results for fault in result.faults()]
        for line in (*summarize(results, score.latencies_ms), *usage.summarize(self.scene.cameras)):
            print(line)
        text, code = conclude(faults, is_test=seconds is not None)
        print(text, flush=True)
        return code

    def _new_score(self, start_ns: int) -> PoseScore:
        n_markers = {name: len(body.markers) for name, body in self.scene.robots.items()}
        return PoseScore(self.clock.true_pose, n_markers, start_ns)

    def _add_to_score(self, pose: RobotPose) -> None:
        if self._score is not None:
            self._score.add(pose)

    def _ticks(self, seconds: float | None) -> Iterator[bool]:
        """Yield every `TICK_S` whether a new second began, for some seconds or without end.

        Raises:
            WebError, ProgramFailed: a program stopped.
        """
        start, elapsed = time.monotonic(), 0
        while seconds is None or time.monotonic() - start < seconds:
            time.sleep(TICK_S)
            self.processes.check("calib")
            before, elapsed = elapsed, int(time.monotonic() - start)
            yield elapsed > before
