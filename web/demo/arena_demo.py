# SPDX-License-Identifier: BSD-3-Clause
"""Runs a whole arena with simulated cameras: wand calibration, then tracking of robots, compared with the truth.

The arena is one of `roundel up` in a temporary folder. Read `Demo.run` first: it lists the steps.
"""

import contextlib
import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import numpy as np
import zenoh
from msgspec.structs import replace

from calib.live.rig_requests import set_rig
from calib.rig.camera import Camera, transform, with_distortion
from calib.rig.rig import Rig, load_rig, save_rig
from calib.world.world_frame import align_cameras
from camera_node.foundation.arrays import Array
from camera_node.foundation.errors import TEMPORARY_FAILURE, USER_ERROR, NetworkError
from camera_node.foundation.supervisor import Supervisor, log_path
from camera_node.protocol.messages import encode
from camera_node.protocol.server_connection import ServerConnection
from camera_node.protocol.session import CONNECT_S
from camera_node.simulation.scene import Scene
from camera_node.sources.frame import SourceSettings
from fusion.protocol.pose_messages import RobotPose
from fusion.server.arena_config import load_arena
from web.arena_folder import ArenaFolder
from web.arena_programs import CALIBRATION, ArenaPrograms
from web.demo.score import PoseScore, ResourceUsage, describe_overload, summarize
from web.errors import WebError
from web.state.feed import ArenaState, DemoProgress, Feed, progress_key
from web.state.subscription import Subscription

ARENA = "demo"
USUAL, ANY_PORT = "tcp/127.0.0.1:7447", "tcp/127.0.0.1:0"  # the README's client connects to the usual port
FILES = ("arena.yaml", "robots.yaml", "wand.yaml")  # beside a scene
MIN_START_S = 3.0  # for the programs to start before the wand session
CALIBRATION_S = 90.0  # limit for the calibration after the wand session
SETTLE_S = 0.5  # after a new calibration, until no pose of the previous one arrives
ACQUISITION_S = 5.0  # for all robots to be acquired; a robot that is not tracked then counts as lost
TICK_S = 0.05
# Errors of carefully calibrated lenses: relative focal length, principal point in pixels, k1.
LENS_SIGMA = 6e-4, 0.5, 5e-4
TAIL_LINES = 8  # of a log, that the message of a failure quotes
RECENT = 100  # poses whose median latency is shown


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
    path = Path(tempfile.mkdtemp(prefix="roundel-demo-"))
    try:
        with interrupt_on_signals(), Demo(scene_path, path, listen) as demo:
            code = demo.run(page, seconds)
    except ProgramFailed as error:
        print(f"the demo failed: {error}", flush=True)
        return 1
    if code:
        print(f"the programs' logs are in {path}", flush=True)
    else:
        shutil.rmtree(path, ignore_errors=True)
    return code


def create_folder(path: Path, scene_path: Path, scene: Scene) -> ArenaFolder:
    """The folder of the demo's arena: the files beside the scene, and a rig of the cameras' calibrated lenses.

    Raises:
        WebError: one of the files is missing.
    """
    for name in FILES:
        try:
            shutil.copy(scene_path.parent / name, path)
        except OSError as error:
            raise WebError(f"{scene_path.parent / name} can't be read: {error.strerror}") from None
    folder = ArenaFolder(path)
    folder.create(ARENA, None, is_local=True)
    save_rig(Rig(cameras=calibrated_lenses(scene)), folder.rig)
    return folder


def calibrated_lenses(scene: Scene) -> dict[str, Camera]:
    """The lenses of a scene as careful calibrations know them: with errors, and the standard deviations of these."""
    rng, focal, centre_px, k1 = np.random.default_rng(scene.seed), *LENS_SIGMA
    cameras = {}
    for name, entry in scene.rig_entries().items():
        camera = with_distortion(Camera(**entry))
        errors, parameters = rng.standard_normal(4), camera.parameters
        parameters[:2] *= 1 + focal * errors[0]
        parameters[2:5] += errors[1:] * [centre_px, centre_px, k1]
        sigma = (focal * camera.fx, focal * camera.fy, centre_px, centre_px, k1)
        cameras[name] = replace(camera.with_parameters(parameters), lens_sigma=sigma)
    return cameras


def require_poses(rig: Rig, cameras: Iterable[str]) -> None:
    """Raise ProgramFailed, with the reasons, if the wand session placed only some of the cameras."""
    reasons = rig.calibration.get("unplaced", {})
    if missing := sorted(set(cameras) - set(rig.placed())):
        why = "; ".join(f"{name}: {reasons.get(name, 'it was not recorded')}" for name in missing)
        raise ProgramFailed(f"the calibration has no pose for {why}")


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
    """Runs the steps of the demo, and prints one line per second; a context manager, within which a server runs.

    Args:
        scene_path: a scene, with the arena's files beside it.
        path: an empty folder for the arena's files and the logs.
        listen: the server's Zenoh endpoint; None for port 7447, or a free one if that is taken.

    Raises:
        ConfigError, WebError: a file is invalid, or the endpoint is taken.
        ProgramFailed: the server ended in another way, or did not listen in time.
    """

    def __init__(self, scene_path: Path, path: Path, listen: str | None = None) -> None:
        self.scene, self.path = Scene.load(scene_path), path
        self._scene_path, self._listen = scene_path, listen
        self._folder = create_folder(path, scene_path, self.scene)
        self._supervisor = Supervisor(self._ended, path, restarts=False)
        self._programs = ArenaPrograms(self._supervisor, self._folder, load_arena(self._folder.config))
        self._score: PoseScore | None = None
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> "Demo":
        with self._stack as stack:
            stack.enter_context(self._supervisor)
            start = time.monotonic()
            self.endpoint = self._start_server()
            startup_s = time.monotonic() - start
            connection = stack.enter_context(ServerConnection([self.endpoint]))
            self.session = connection.session(CONNECT_S)
            # cameras, page and calibration start together
            self.delay_s = start_delay_s(len(self.scene.cameras) + 2, startup_s)
            self.clock = SceneClock(self.scene, time.time_ns() + round(self.delay_s * 1e9))
            self.feed = Feed(ARENA, self._add_to_score)
            stack.callback(Subscription(connection, self.feed).close)
            self._reporter = ProgressReporter(self.session, ARENA, self.clock)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    def run(self, page: tuple[str, int] | None, seconds: float | None) -> int:
        """Run all steps; return the exit code."""
        self._start_programs(page)
        self._wait_for_calibration()
        self._align_to_scene()
        self._wait_for_robots()
        return self._track_and_score(seconds)

    def _start_server(self) -> str:
        """Start the server; return its endpoint. It takes its port itself, so that no other program can before."""
        try:
            return self._start_server_on(self._listen or USUAL)
        except WebError as error:
            if self._listen is not None or USUAL not in str(error):  # or a fault in a file
                raise
        return self._start_server_on(ANY_PORT)

    def _start_server_on(self, listen: str) -> str:
        try:
            return self._programs.start_server(listen, threading.Event())[0]
        except NetworkError as error:
            raise ProgramFailed(f"{error}; {quote_end(log_path(self.path, 'server'))}") from None

    def _start_programs(self, page: tuple[str, int] | None) -> None:
        """Start the cameras, the viewer and the calibration."""
        sources = [f"sim:{name}" for name in self.scene.cameras]
        settings = SourceSettings(scene=self._scene_path, epoch_ns=self.clock.epoch_ns)
        self._programs.cameras(sources, settings).start()
        if page is not None:
            print(*self._programs.start_page(*page).instructions(), sep="\n", flush=True)
        print(f"Zenoh endpoint of arena '{ARENA}': {self.endpoint}", flush=True)
        self._programs.start_wand_calibration(self.delay_s + self.scene.wave_s)

    def _ended(self, name: str, code: int) -> None:
        """The calibration ends when its work is done; any other end is a failure."""
        if code or name != CALIBRATION:
            raise_failure(name, code, log_path(self.path, name))

    def _wait_for_calibration(self) -> None:
        """Report the wand session until `calib` has calibrated the cameras."""
        for whole_second in self._ticks(self.delay_s + self.scene.wave_s + CALIBRATION_S):
            if CALIBRATION not in self._supervisor:
                return
            text = describe_calibration_step(self.clock, self.feed.state())
            self._reporter.report(text, self.clock.wand_share(), whole_second)
        raise ProgramFailed(
            f"the calibration did not end in time; {quote_end(log_path(self.path, CALIBRATION))}"
        )

    def _align_to_scene(self) -> None:
        """Align the calibration with the cameras' true positions: a wand does not define a world frame."""
        rig = load_rig(self._folder.rig)
        require_poses(rig, self.scene.cameras)
        positions = {name: self.scene.T_world_cam(name)[:3, 3] for name in self.scene.cameras}
        aligned, errors_m = align_cameras(rig, positions)
        set_rig(self.session, ARENA, aligned, "roundel demo")
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
        usage = ResourceUsage(self._supervisor.pids, self.feed)
        score = self._score = self._new_score(usage.start_ns)
        try:
            for whole_second in self._ticks(seconds):
                if whole_second:
                    usage.measure()
                    self._reporter.report(describe_errors(score), 1.0, print_text=False)
                    print(describe_tracking_step(score, usage, self.scene.cameras), flush=True)
        except KeyboardInterrupt:  # the user ended the demo and expects the summary
            print(flush=True)
        self._score = None
        results = score.results(usage.start_ns, time.time_ns())
        status = self.feed.state().status
        reasons = status.message.not_acquired if status else {}
        faults = [fault for result in results for fault in result.faults(reasons.get(result.robot))]
        usual = {name: camera.fps for name, camera in self.scene.cameras.items()}
        overload = describe_overload(usage.frame_rates(usual), usual)
        for line in (*summarize(results, score.latencies_ms), *usage.summarize(usual), *overload):
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
            self._supervisor.tend()
            before, elapsed = elapsed, int(time.monotonic() - start)
            yield elapsed > before


class ProgramFailed(Exception):
    """A child stopped unexpectedly; the message quotes the end of its log."""


def raise_failure(name: str, code: int, log: Path) -> None:
    """Raise the error that describes how a child ended.

    Raises:
        WebError: with one line on a fault that the user can correct.
        ProgramFailed: otherwise.
    """
    lines = log.read_text(errors="replace").strip().splitlines()
    if code in (USER_ERROR, TEMPORARY_FAILURE) and lines and lines[-1].startswith("error: "):
        raise WebError(f"{name}: {lines[-1].removeprefix('error: ')}")
    raise ProgramFailed(f"{name} stopped with code {code}; {quote_end(log)}")


def quote_end(log: Path) -> str:
    """Name a log, and quote its last lines if it has any."""
    lines = log.read_text(errors="replace").strip().splitlines()
    return "\n".join([f"its log is {log}", *(f"  {line}" for line in lines[-TAIL_LINES:])])


@contextmanager
def interrupt_on_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGINT, SIGTERM and SIGHUP, so that `with` blocks clean up."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    before = [signal.signal(number, interrupt) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


class SceneClock:
    """The simulated scene with its epoch: converts wall-clock time (ns) to scene time (s)."""

    def __init__(self, scene: Scene, epoch_ns: int) -> None:
        self.scene, self.epoch_ns = scene, epoch_ns

    def seconds(self, t_ns: int | None = None) -> float:
        """Return the scene time at `t_ns`, or now."""
        return ((time.time_ns() if t_ns is None else t_ns) - self.epoch_ns) * 1e-9

    def true_pose(self, robot: str, t_ns: int) -> Array | None:
        """Return T_world_robot (4, 4), or None while the robot is not in the scene."""
        return self.scene.robot_pose(robot, self.seconds(t_ns))

    def wand_points(self) -> dict[str, tuple]:
        """Return the wand's true marker positions by name, as in `DemoProgress`; empty without a wand."""
        T = self.scene.wand_pose(self.seconds())
        return {} if T is None else {"wand": tuple(map(tuple, transform(T, self.scene.wand.points).tolist()))}

    def wand_share(self) -> float:
        """Return the completed share of the wand session, 0 to 1."""
        return min(1.0, max(0.0, self.seconds() / self.scene.wave_s))


class ProgressReporter:
    """Publishes status lines for the page and prints them."""

    def __init__(self, session: zenoh.Session, arena: str, clock: SceneClock) -> None:
        self._session, self._key, self._clock = session, progress_key(arena), clock

    def report(self, text: str, share: float, print_text: bool) -> None:
        """Publish a status line and the completed share of the step, 0 to 1; also print the line if wanted."""
        points = self._clock.wand_points()
        progress = DemoProgress(t_ns=time.time_ns(), text=text, share=share, true_points=points)
        self._session.put(self._key, encode(progress))
        if print_text:
            print(text, flush=True)


def describe_calibration_step(clock: SceneClock, state: ArenaState) -> str:
    """Return the status line before, during and after the wand session."""
    t_s, wave_s = clock.seconds(), clock.scene.wave_s
    if t_s >= wave_s:
        return f"the wand session is over; calibrating ({t_s - wave_s:.0f} s)"
    if t_s < 0:
        return f"starting programs; the wand session begins in {-t_s:.0f} s"
    shares = ", ".join(f"{name} {100 * c.share():.0f} %" for name, c in sorted(state.coverage.items()))
    return f"waving the wand, {t_s:.0f} of {wave_s:.0f} s; image coverage: {shares or 'no camera yet'}"


def describe_errors(score: PoseScore) -> str:
    """Return the robots' position errors for the page, which has all other figures itself."""
    errors = ", ".join(f"{robot} {score.recent_mm(robot):.2f}" for robot in score.errors)
    return f"simulation: position errors in mm: {errors}"


def describe_tracking_step(score: PoseScore, usage: ResourceUsage, cameras: Iterable[str]) -> str:
    """Return the status line while the robots are tracked."""
    errors = ", ".join(f"{robot} {score.recent_mm(robot):.2f}" for robot in score.errors)
    rates = " ".join(f"{rate:.0f}" for rate in usage.frame_rates(cameras).values())
    latencies = score.latencies_ms[-RECENT:]
    p50 = f"{np.median(latencies):.1f} ms" if latencies else "unknown"
    return f"{usage.seconds():.0f} s: error mm {errors}; latency {p50}; frames/s {rates}"
