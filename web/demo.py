# SPDX-License-Identifier: BSD-3-Clause
"""A whole arena without hardware: simulated cameras, a wand wave to calibrate, then robots."""

import contextlib
import os
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil

import web
from calib.live.collect import publish_rig
from calib.rig.camera import Camera, transform
from calib.rig.rig import Rig, load_rig, save_rig
from calib.world.world_frame import align_cameras
from camera_node.arrays import Array
from camera_node.errors import ConfigError
from camera_node.protocol.messages import encode
from camera_node.protocol.session import open_client
from camera_node.simulation.scene import Scene
from fusion.protocol.messages import RobotPose
from web.errors import WebError
from web.feed import Feed, Latest
from web.messages import DemoProgress, progress_key
from web.processes import Processes, ProgramFailed, ended_by_signals
from web.score import Score, summarise
from web.subscription import Subscription
from web.usage import Usage

ARENA = "demo"
START_S = 3.0  # for the programs to come up before the wave begins, at the least
SOLVE_S = 90.0  # after the wave, for calibration to be done
SETTLE_S = 0.5  # after a new calibration, for poses of the old one to be gone
ACQUIRE_S = 5.0  # after calibration, for robots to be found; whatever is missing then counts as lost
TICK_S = 0.05


def default_scene() -> Path:
    """The scene of the checkout, or the one that was installed with the package.

    Raises:
        ConfigError: neither is there.
    """
    package = Path(web.__file__).parent
    for configs in (package.parent / "configs", package / "configs"):
        if (path := configs / "demo" / "scene.yaml").is_file():
            return path
    raise ConfigError("the demo's scene.yaml is not installed; give one with --scene scene.yaml")


def free_endpoint() -> str:
    """A Zenoh endpoint on loopback that nobody listens on: the usual port, or where that is taken any other."""
    for port in (7447, 0):
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)) as server:
            return f"tcp/127.0.0.1:{server.getsockname()[1]}"
    raise WebError("no port on 127.0.0.1 can be listened on; give an endpoint with --listen")


def coming_up_s(programs: int) -> float:
    """How long so many programs take to come up at once: each about the work that this one was, on all processors."""
    alone_s = time.time() - psutil.Process().create_time()
    return max(START_S, alone_s * programs / (os.cpu_count() or 1))


def run_demo(
    scene_path: Path, listen: str | None, page: tuple[str, int] | None, seconds: float | None
) -> int:
    """Play the arena and return the exit code: 0 where poses are right, 1 where not or where a program failed.

    Args:
        scene_path: a scene; beside it lie arena.yaml, robots.yaml and wand.yaml.
        listen: the server's Zenoh endpoint; a free one is chosen where None.
        page: host and port of the viewer; none is started where None.
        seconds: how long to track after calibration; until Ctrl-C where None.

    Raises:
        ConfigError, WebError: something that a person can mend, in the files or on this machine.
    """
    scene = Scene.load(scene_path)
    folder = Path(tempfile.mkdtemp(prefix="roundel-demo-"))
    try:
        with ended_by_signals(), Processes(folder) as processes:
            code = Demo(scene, scene_path.parent, processes, listen or free_endpoint()).play(page, seconds)
    except ProgramFailed as error:
        print(f"the demo failed: {error}", flush=True)
        return 1
    if code:
        print(f"what each program said is in {folder}", flush=True)
    else:
        shutil.rmtree(folder, ignore_errors=True)
    return code


class Demo:
    """The steps of the demo, in order; each prints one line a second."""

    def __init__(self, scene: Scene, files: Path, processes: Processes, endpoint: str) -> None:
        self.scene, self.files, self.processes, self.endpoint = scene, files, processes, endpoint
        self.session = open_client([endpoint])
        self.wave_in_s = coming_up_s(len(scene.cameras) + 3)  # server, page and calibration
        self.epoch_ns = time.time_ns() + round(self.wave_in_s * 1e9)
        self.feed = Feed(ARENA, self._take_pose)
        self.subscription = Subscription(self.session, self.feed)
        self._score: Score | None = None

    def play(self, page: tuple[str, int] | None, seconds: float | None) -> int:
        """All of it; returns the exit code."""
        try:
            self._start(page)
            self._calibrate()
            self._survey()
            self._acquire()
            return self._track(seconds)
        finally:
            self.subscription.close()
            self.session.close()

    def _start(self, page: tuple[str, int] | None) -> None:
        folder, files, start = self.processes.folder, self.files, self.processes.start
        connect = ["--connect", self.endpoint, "--arena", ARENA]
        start("fusion", "fusion", ["--config", str(files / "arena.yaml"), "--listen", self.endpoint])
        for name in self.scene.cameras:
            camera = ["--source", "sim", "--scene", str(files / "scene.yaml"), "--name", name]
            start(name, "camera_node", [*camera, "--epoch-ns", str(self.epoch_ns), *connect])
        if page is not None:
            start("web", "web", [*connect, "--host", page[0], "--port", str(page[1])])
            print(f"open http://{page[0]}:{page[1]} in a browser to watch; Ctrl-C ends", flush=True)
        print(f"arena '{ARENA}' speaks Zenoh on {self.endpoint}", flush=True)
        intrinsics = {name: Camera(**entry) for name, entry in self.scene.rig_entries().items()}
        save_rig(Rig(cameras=intrinsics), folder / "intrinsics.yaml")
        wave = [
            "wand",
            "--live",
            "--wand",
            str(files / "wand.yaml"),
            "--seconds",
            str(self.wave_in_s + self.scene.wave_s),
        ]
        rigs = ["--rig", str(folder / "intrinsics.yaml"), "--out", str(folder / "rig.yaml")]
        start("calib", "calib", [*wave, *rigs, *connect])

    def _calibrate(self) -> None:
        """Wave the wand until `calib` has placed the cameras."""
        for whole_second in self._ticks(self.wave_in_s + self.scene.wave_s + SOLVE_S):
            if self.processes.finished("calib"):
                return
            self._tell(self._describe_wave(self.feed.latest()), self._wave_share(), whole_second)
        raise ProgramFailed(f"no calibration came in time; the logs are in {self.processes.folder}")

    def _survey(self) -> None:
        """Make the calibration's world the scene's, by the cameras' true places: a wand alone fixes no world."""
        rig = load_rig(self.processes.folder / "rig.yaml")
        if missing := set(self.scene.cameras) - set(rig.placed()):
            raise ProgramFailed(f"calibration did not place {', '.join(sorted(missing))}")
        moved, misses_m = align_cameras(
            rig, {name: self.scene.T_world_cam(name)[:3, 3] for name in self.scene.cameras}
        )
        publish_rig(self.session, ARENA, moved)
        worst = 1e3 * max(misses_m.values())
        print(
            f"calibrated: {len(misses_m)} cameras, {worst:.2f} mm from their true places at most", flush=True
        )

    def _acquire(self) -> None:
        """Give the server the time to find the robots."""
        score = self._score = self._new_score(time.time_ns() + round(SETTLE_S * 1e9))
        for _ in self._ticks(ACQUIRE_S):
            if score.all_tracked():
                break

    def _track(self, seconds: float | None) -> int:
        """Follow the robots, then sum up; the exit code."""
        usage = Usage(self.processes, self.feed)
        score = self._score = self._new_score(usage.start_ns)
        try:
            for whole_second in self._ticks(seconds):
                if whole_second:
                    usage.note_memory()
                    self._tell(self._describe_tracking(score, usage), 1.0, whole_second)
        except KeyboardInterrupt:  # whoever ends it wants the summary
            print(flush=True)
        self._score = None
        results = score.results(usage.start_ns, time.time_ns())
        faults = [fault for result in results for fault in result.faults()]
        for line in (*summarise(results, score.latencies_ms), *usage.summarise(self.scene.cameras)):
            print(line)
        print(f"FAILED: {'; '.join(faults)}" if faults else "all robots were tracked, and right", flush=True)
        return 1 if faults else 0

    def _new_score(self, start_ns: int) -> Score:
        markers = {name: len(body.markers) for name, body in self.scene.robots.items()}
        return Score(self._truth, markers, start_ns)

    def _ticks(self, seconds: float | None) -> Iterator[bool]:
        """Every `TICK_S`, whether a whole second has passed; for so long or for ever. A program that fails raises."""
        start, whole = time.monotonic(), 0
        while seconds is None or time.monotonic() - start < seconds:
            time.sleep(TICK_S)
            self.processes.check("calib")
            passed = int(time.monotonic() - start)
            yield passed > whole
            whole = passed

    def _take_pose(self, pose: RobotPose) -> None:
        if self._score is not None:
            self._score.add(pose)

    def _truth(self, robot: str, t_ns: int) -> Array | None:
        return self.scene.robot_pose(robot, self._scene_time(t_ns))

    def _scene_time(self, t_ns: int) -> float:
        return (t_ns - self.epoch_ns) * 1e-9

    def _wave_share(self) -> float:
        return min(1.0, max(0.0, self._scene_time(time.time_ns()) / self.scene.wave_s))

    def _describe_wave(self, latest: Latest) -> str:
        t_s = self._scene_time(time.time_ns())
        if t_s >= self.scene.wave_s:
            return f"the wave is over; calibrating ({t_s - self.scene.wave_s:.0f} s)"
        if t_s < 0:
            return f"the programs start; the wave begins in {-t_s:.0f} s"
        seen = ", ".join(f"{name} {100 * c.share:.0f} %" for name, c in sorted(latest.coverage.items()))
        return f"waving the wand, {t_s:.0f} of {self.scene.wave_s:.0f} s; seen in {seen or 'no camera yet'}"

    def _describe_tracking(self, score: Score, usage: Usage) -> str:
        errors = ", ".join(f"{robot} {score.recent_mm(robot):.2f}" for robot in score.tracks)
        frames = " ".join(f"{rate:.0f}" for rate in usage.frame_rates(self.scene.cameras).values())
        latency = score.latencies_ms[-100:]
        p50 = f"{np.median(latency):.1f} ms" if latency else "unknown"
        return f"{usage.seconds():.0f} s: error mm {errors}; latency {p50}; frames/s {frames}"

    def _tell(self, text: str, share: float, aloud: bool) -> None:
        """Tell the viewer, and the terminal too when it is to be said aloud."""
        T = self.scene.wand_pose(self._scene_time(time.time_ns()))
        ghosts = (
            {} if T is None else {"wand": tuple(map(tuple, transform(T, self.scene.wand.points).tolist()))}
        )
        progress = DemoProgress(t_ns=time.time_ns(), text=text, share=share, ghosts=ghosts)
        self.session.put(progress_key(ARENA), encode(progress))
        if aloud:
            print(text, flush=True)
