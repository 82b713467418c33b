# SPDX-License-Identifier: BSD-3-Clause
"""A first arena: four unknown cameras on two machines, an operator who clicks in a browser, and a program with poses.

The cameras are recordings, which `roundel up` and `roundel camera` play as live ones: of the first machine folders of
pictures, of the second videos. Someone waves a wand, lays the L-frame on the floor and takes it away, and sets a robot
down, which then drives on a circle (`PHASES`). Each of these motions repeats, so that few frames are rendered; a loaded
machine, on which the operator waits longer, has more repetitions. `Operator` has no other means than the page.
"""

import contextlib
import csv
import json
import os
import re
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import yaml
from playwright.sync_api import Locator, Page, TimeoutError, expect, sync_playwright

from calib.rig.rig import load_rig
from camera_node.foundation.arrays import Array, Grey
from camera_node.foundation.config import example_file
from camera_node.simulation.scene import Scene
from camera_node.simulation.simulated_camera import render_recording
from camera_node.sources.recorded_frames import read_grey
from tests.benchmarks.faults.network import Loopback
from tests.conftest import free_port
from tests.waiting import slowness, wait_for
from tests.web.browser import CHROMIUM, FLAGS
from tests.web.roundel.programs import Program, roundel_command

SERVER, CAMERAS = "server", "cameras"  # the machines
ROBOT = "rover"
FOLDERS, VIDEOS = ("north", "east"), ("south", "west")  # the cameras of the first and of the second machine
FPS = {"north": 20.0, "east": 19.75, "south": 20.25, "west": 19.5}  # whole numbers of frames in 4 s
ROUND_S = 12.0
RADIUS_M = 0.6  # of the circle on which the robot drives
DIAMETER_M = 0.09
MARKERS = [[0.1, 0.0, 0.0], [-0.08, 0.05, 0.0], [-0.03, -0.11, 0.0]]  # of the robot
LOOK_MS = 5_000  # of an operator, at the outcome of a measurement, before the next click
STEP_MS = 60_000  # for the page to show the outcome of a step, on a loaded machine
CALIBRATION_MS = 150_000
LONG_ENOUGH = r"^(3[6-9]|[4-9]\d|1\d\d) s[:;]"  # three rounds of the wand
MAX_TIMES = 2.0  # that phases are longer on a loaded machine
N_POSES = 500  # two rounds at 20 a second
HEIGHT_M = 0.15  # of the robot's markers above the floor
CENTRE_M = np.add(np.mean(MARKERS, axis=0), [0.0, 0.0, HEIGHT_M])  # of the circle of the markers' mean
STOOD_M = 0.1

WAND_MOTION = {
    "x_m": {"amplitude": 1.0, "period_s": 6.0},
    "y_m": {"amplitude": 0.9, "period_s": 4.0, "phase_deg": 40},
    "z_m": {"mean": 0.65, "amplitude": 0.5, "period_s": 12.0, "phase_deg": 110},
    "yaw_deg": {"mean": 20, "amplitude": 170, "period_s": 12.0},
    "pitch_deg": {"amplitude": 18, "period_s": 4.0},
    "roll_deg": {"amplitude": 18, "period_s": 3.0, "phase_deg": 70},
}
STANDING = {"x_m": {"mean": 0.0}, "y_m": {"mean": RADIUS_M}, "z_m": {"mean": HEIGHT_M}}
DRIVING = {
    "x_m": {"amplitude": RADIUS_M, "period_s": ROUND_S},
    "y_m": {"amplitude": RADIUS_M, "period_s": ROUND_S, "phase_deg": 90},
    "z_m": {"mean": HEIGHT_M},
}


@dataclass(frozen=True)
class Phase:
    """A part of the recording: `period_s` of it are rendered, and repeated until `seconds` are full.

    The arena contains the robot, or in its place the body of an example file, which moves as `motion` says.
    """

    seconds: float
    period_s: float
    body: str
    motion: dict


PHASES = (
    Phase(72.0, 12.0, "wand.yaml", WAND_MOTION),
    Phase(60.0, 4.0, "l.yaml", {}),
    Phase(60.0, 4.0, ROBOT, STANDING),
    Phase(72.0, ROUND_S, ROBOT, DRIVING),
)


def render(folder: Path) -> None:
    """Write one period of each phase, unless the folder has them."""
    missing = [k for k in range(len(PHASES)) if not (folder / f"phase{k}").exists()]
    with ProcessPoolExecutor(
        mp_context=get_context("spawn")
    ) as processes:  # a fork has no thread of Zenoh or OpenCV
        for done in [processes.submit(_render_phase, folder, k) for k in missing]:
            done.result()


def repeat(folder: Path) -> float:
    """Write the pictures `<camera>/<t_ns>.png` of `FOLDERS`, and the videos `<camera>/<camera>.avi` of `VIDEOS`, beside
    the rendered phases; return how many times as long as `PHASES` these are."""
    times = min(slowness(), MAX_TIMES)
    for name in FPS:
        shutil.rmtree(folder / name, ignore_errors=True)
        frames = _repeated(folder, name, times)
        (folder / name).mkdir()
        if name in FOLDERS:
            for t_ns, path in frames:
                os.link(path, folder / name / f"{t_ns}.png")
        else:
            _write_video(folder / name / f"{name}.avi", frames)
    return times


def _render_phase(folder: Path, k: int) -> None:
    """Render one period of a phase, beginning at time 0, into `folder/phase<k>`."""
    phase, place = PHASES[k], folder / f"phase{k}"
    place.mkdir(parents=True)
    text = example_file("demo/scene.yaml").read_text(encoding="utf-8")
    scene = yaml.safe_load(text)
    for name, fps in FPS.items():
        scene["cameras"][name]["fps"] = fps
    scene["wave_s"] = 0.0 if phase.body == ROBOT else phase.period_s + 1.0
    scene["wand_motion"], scene["robot_motions"] = phase.motion, {ROBOT: phase.motion}
    (place / "scene.yaml").write_text(json.dumps(scene))
    body = "wand.yaml" if phase.body == ROBOT else phase.body
    (place / "wand.yaml").write_text(example_file(body).read_text())
    robots = {"robots": {ROBOT: {"diameter_m": DIAMETER_M, "markers": MARKERS}}}
    (place / "robots.yaml").write_text(json.dumps(robots))
    render_recording(Scene.load(place / "scene.yaml"), place, 0.0, phase.period_s)


def _repeated(folder: Path, camera: str, times: float) -> list[tuple[int, Path]]:
    """Time (ns) and file of each frame of a camera, from the first phase to the last, each `times` as long."""
    frames, start_s = [], 0.0
    for k, phase in enumerate(PHASES):
        paths = sorted((folder / f"phase{k}" / camera).glob("*.png"))
        for _ in range(round(times * phase.seconds / phase.period_s)):
            frames += [(int(path.stem) + round(start_s * 1e9), path) for path in paths]
            start_s += phase.period_s
    return frames


def _write_video(path: Path, frames: list[tuple[int, Path]]) -> None:
    pictures: dict[Path, Grey] = {}
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), FPS[path.stem], (640, 480), False)
    for _, picture in frames:
        if picture not in pictures:
            pictures[picture] = read_grey(picture)
        video.write(pictures[picture])
    video.release()
    with path.with_name("timestamps.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["frame_time"])
        rows.writerows([f"{t_ns / 1e9:.9f}"] for t_ns, _ in frames)


class Operator:
    """Works with the page of an arena, step by step.

    Args:
        page: the open page.
        wait_for: waits until the body of an example file, or the robot, lies in the arena.
        picture: called with the name of each step that the documentation shows.

    Attributes:
        clicks: so far, with those on tabs; a text that is typed is none.
        repeated: those of them that repeat a measurement.
    """

    clicks, repeated = 0, 0

    def __init__(
        self, page: Page, wait_for: Callable[[str], object], picture: Callable[[str], object]
    ) -> None:
        self._page, self._wait_for, self._picture = page, wait_for, picture

    def check_cameras(self) -> None:
        """Wait until all cameras send, and their pictures are shown."""
        self._tab("Cameras")
        for name in FPS:
            self._page.locator(f"img[alt={name}]").wait_for(timeout=STEP_MS)
        self._picture("cameras")

    def calibrate(self) -> str:
        """Record the wand until the session ends by itself or saw three rounds, and accept; return the outcome."""
        self._tab("Calibrate")
        self._click("Start wand session")
        self._button("End wand session").wait_for(timeout=STEP_MS)
        long_enough = self._page.get_by_text(re.compile(LONG_ENOUGH))
        self._button("Start wand session").or_(long_enough).wait_for(timeout=STEP_MS)
        self._picture("wand")
        if self._button("End wand session").is_enabled():
            self._click("End wand session")
        self._button("Start wand session").wait_for(timeout=CALIBRATION_MS)
        accept = self._button("Accept the calibration")
        expect(accept, self._page.locator("body").inner_text()).to_be_enabled(timeout=STEP_MS)
        self._picture("calibrate")
        self._click("Accept the calibration")
        outcome = self._page.get_by_text("in force on the server")
        outcome.wait_for(timeout=STEP_MS)
        accept.wait_for(state="hidden", timeout=STEP_MS)  # what is below moves up
        return outcome.inner_text()

    def define_floor(self) -> str:
        """Have the L-frame define floor and origin; again while it is not on the floor yet."""
        self._press(self._page.get_by_text("Floor and origin", exact=True))
        self._press(self._page.locator("[role=combobox][value^=wand]"))
        self._press(self._page.get_by_role("option", name="L-frame"))
        self._wait_for("l.yaml")
        self._click_until("Measure", self._page.get_by_text("the new axes"))
        self._picture("floor")
        self._click("Accept the new world")
        outcome = self._page.get_by_text("the new world is")
        outcome.wait_for(timeout=STEP_MS)
        return outcome.inner_text()

    def define_robot(self, name: str) -> str:
        """Define a robot from everything stationary; again, as an operator would, while something moves."""
        self._tab("Robots")
        label = self._page.get_by_text("Name", exact=True).and_(self._page.locator(":visible"))
        label.locator("xpath=ancestor::*[.//input][1]").locator("input").fill(name)
        outcome = self._page.get_by_text(f"the server now tracks {name}")
        self._wait_for(name)
        self._click_until("Define from everything stationary", outcome)
        self._picture("robots")
        return outcome.inner_text()

    def program(self) -> str:
        """The program that the page offers."""
        self._tab("Status")
        self._press(self._page.get_by_text("Poses for your program"))
        text = self._page.locator("pre").filter(has_text="Arena.connect")
        text.wait_for(timeout=STEP_MS)
        return text.inner_text()

    def _tab(self, name: str) -> None:
        self._press(self._page.get_by_role("tab", name=name))

    def _button(self, name: str) -> Locator:
        return self._page.get_by_role("button", name=name, exact=True)

    def _click(self, name: str) -> None:
        self._press(self._button(name))

    def _click_until(self, name: str, outcome: Locator) -> None:
        """Click a button, and again if it is enabled without the outcome: something moved, or was not there yet.

        The button is disabled while it measures, which a browser that draws seldom may never show.
        """
        for _ in range(60):
            self._click(name)
            with contextlib.suppress(TimeoutError):
                outcome.wait_for(timeout=LOOK_MS)
            outcome.or_(self._page.locator("button:enabled", has_text=name)).first.wait_for(timeout=STEP_MS)
            if outcome.count():
                return
            self.repeated += 1
        raise AssertionError(f"{name} had no outcome")

    def _press(self, control: Locator) -> None:
        control.click(timeout=STEP_MS)
        self.clicks += 1


class FirstArena:
    """The two machines, and the browser of the first one; a context manager.

    Args:
        network: with places `SERVER` and `CAMERAS`.
        recordings: in which `render` wrote the phases.
        folder: in which both commands run.
    """

    def __init__(self, network: Loopback, recordings: Path, folder: Path) -> None:
        self._network, self._recordings, self._folder = network, recordings, folder
        self._stack = contextlib.ExitStack()
        self.port = free_port()

    def __enter__(self) -> "FirstArena":
        self.times = repeat(self._recordings)
        with self._stack as stack:
            folders = [self._recordings / name for name in FOLDERS]
            videos = [self._recordings / name / f"{name}.avi" for name in VIDEOS]
            self.up = self._start(SERVER, stack, "up", "lab", "--port", self.port, "--source", *folders)
            self.camera = self._start(CAMERAS, stack, "camera", "--source", *videos)
            self._stack = stack.pop_all()
        return self

    def begin_s(self, k: int) -> float:
        """When a phase begins, seconds after the recordings."""
        return self.times * sum(phase.seconds for phase in PHASES[:k])

    def begin(self) -> None:
        """The cameras play: the phases of the recordings are counted from here."""
        self._began_s = time.monotonic()

    def wait_for_body(self, body: str) -> None:
        """Wait until its first phase has begun."""
        begin_s = self.begin_s(next(k for k, phase in enumerate(PHASES) if phase.body == body))
        wait_for(lambda: time.monotonic() - self._began_s > begin_s, deadline_s=begin_s)

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    def _start(self, place: str, stack: contextlib.ExitStack, *words: object) -> Program:
        program = Program(self._network.command(place, roundel_command(*words)), self._folder)
        stack.callback(program.stop)
        return program

    @contextlib.contextmanager
    def browsing(self) -> Iterator[Page]:
        """Open the page in a browser of the server's machine."""
        assert CHROMIUM is not None
        script = self._folder / "browser"
        command = shlex.join(self._network.command(SERVER, [CHROMIUM]))
        script.write_text(f'#!/bin/sh\nexec {command} "$@"\n')
        script.chmod(0o755)
        self.up.until("the page is at|http://")
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=script, args=FLAGS)
            page = browser.new_page(viewport={"width": 1600, "height": 1000})
            page.goto(f"http://127.0.0.1:{self.port}")
            try:
                yield page
            except BaseException:
                print(f"the page shows:\n{page.inner_text('body')}")
                raise
            finally:
                browser.close()

    def run_program(self, code: str, is_enough: Callable[[list[str]], bool]) -> list[str]:
        """Run a program on the server's machine until it printed enough lines; return them."""
        path = self._folder / "poses.py"
        path.write_text(code)
        program = Program(self._network.command(SERVER, [sys.executable, "-P", str(path)]), self._folder)
        try:
            wait_for(lambda: is_enough(list(program.lines)), deadline_s=self.begin_s(len(PHASES)))
        finally:
            program.stop(signal.SIGKILL)
        return program.lines


def read_poses(lines: Iterable[str]) -> tuple[Array, Array]:
    """Times (N,) ns and positions (N, 3) of printed poses."""
    rows = [
        (int(match[1]), [float(number) for number in match[2].split(",")])
        for line in lines
        if (match := re.match(r"(\d+) \w+ \(([^)]*)\) \(", line))
    ]
    return np.array([t for t, _ in rows]), np.array([position for _, position in rows]).reshape(-1, 3)


@dataclass(frozen=True)
class Circle:
    """A circle through positions.

    Attributes:
        centre_m: its centre, world.
        radius_m: its radius.
        rms_m: of the distances between the positions and the circle, in space.
        round_s: the time of one round.
    """

    centre_m: Array
    radius_m: float
    rms_m: float
    round_s: float


def fit_circle(t_ns: Array, positions: Array) -> Circle:
    """Fit a circle in space to positions (N, 3) at times (N,): a plane, then a linear fit in it (Kasa)."""
    centre = positions.mean(0)
    _, _, axes = np.linalg.svd(positions - centre)
    u, v, height = ((positions - centre) @ axes.T).T
    A = np.column_stack([2 * u, 2 * v, np.ones(len(u))])
    a, b, c = np.linalg.lstsq(A, u**2 + v**2, rcond=None)[0]
    radius = float(np.sqrt(c + a**2 + b**2))
    off = np.hypot(np.hypot(u - a, v - b) - radius, height)
    angle = np.unwrap(np.arctan2(v - b, u - a))
    rate = np.polyfit((t_ns - t_ns[0]) * 1e-9, angle, 1)[0]
    rms_m, round_s = float(np.sqrt(np.mean(off**2))), float(2 * np.pi / abs(rate))
    return Circle(centre + a * axes[0] + b * axes[1], radius, rms_m, round_s)


@dataclass(frozen=True)
class Outcome:
    """What a first arena achieved.

    Attributes:
        calibration: the page's sentence about it.
        expected_mm: the largest error that the calibration states.
        circle: through the positions that the program printed while the robot drove.
        n_poses: their number.
        clicks: of the operator.
        repeated: those of them that repeat a measurement, because the body is not there yet.
        seconds: from the open page to the last pose.
    """

    calibration: str
    expected_mm: float
    circle: Circle
    n_poses: int
    clicks: int
    repeated: int
    seconds: float


def play(arena: FirstArena, folder: Path, picture: Callable[[Page, str], object]) -> Outcome:
    """Do all steps of the operator in the page of a running arena, then run the page's program.

    Args:
        arena: its two commands run.
        folder: as of the arena.
        picture: called with the page and the name of each step that the documentation shows.
    """
    with arena.browsing() as page:
        picture(page, "begin")
        opened_s = time.monotonic()
        operator = Operator(page, arena.wait_for_body, lambda name: picture(page, name))
        operator.check_cameras()
        arena.begin()
        calibration = operator.calibrate()
        operator.define_floor()
        operator.define_robot(ROBOT)
        code = operator.program()
        lines = arena.run_program(code, lambda lines: len(driven(*read_poses(lines))[0]) > N_POSES)
        seconds = time.monotonic() - opened_s
        t_ns, positions = driven(*read_poses(lines))
        picture(page, "status")
    rig = load_rig(folder / "lab" / "rig.yaml")
    return Outcome(
        calibration,
        rig.calibration["expected_mm"]["worst"],
        fit_circle(t_ns, positions),
        len(t_ns),
        operator.clicks,
        operator.repeated,
        seconds,
    )


def driven(t_ns: Array, positions: Array) -> tuple[Array, Array]:
    """The poses since the robot left the place where it stood."""
    moved = np.linalg.norm(positions - positions[:1], axis=1) > STOOD_M
    first = int(np.argmax(moved)) if moved.any() else len(moved)
    return t_ns[first:], positions[first:]
