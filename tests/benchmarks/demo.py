# SPDX-License-Identifier: BSD-3-Clause
"""The demo with several seeds, also under load: errors of the frames' timestamps, of the poses, and of their claims.

`python -m tests.benchmarks.demo [--seed 7] [--runs 5] [--browser] [--loops 3] [--apart]`. All programs are real and
share one clock, so an exact timestamp equals the middle of the simulated exposure; any difference is an error of the
node. A calibration's error is common to all poses of a run, so claims are judged by their mean over runs.
"""

import contextlib
import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import tyro
import zenoh

from camera_node.foundation.config import example_file
from camera_node.protocol.messages import CameraStatus, Detections, decode
from tests.conftest import free_port
from tests.waiting import wait_for_port
from tests.web.browser import CHROMIUM, FLAGS
from web.demo.arena_demo import ANY_PORT, Demo, interrupt_on_signals

BUSY = "while True: pass"
STAY_OPEN = "--remote-debugging-port=0"


class TimestampErrors:
    """Errors of the timestamps of a demo's frames, microseconds, and the bounds that the cameras report."""

    def __init__(self, demo: Demo) -> None:
        self._scene, self._epoch_ns = demo.scene, demo.clock.epoch_ns
        self._frames: list[
            tuple[str, int, float]
        ] = []  # camera, index of the exposure, error in microseconds
        self._bounds: list[float] = []
        keys = demo.feed.keys
        self._subscribers = [
            demo.session.declare_subscriber(keys.detections(), self._take_frame),
            demo.session.declare_subscriber(keys.camera_status(), self._take_status),
        ]

    def _take_frame(self, sample: zenoh.Sample) -> None:
        message = decode(sample.payload.to_bytes(), Detections)
        camera = self._scene.camera(message.camera)
        since_s = (message.t_ns - self._epoch_ns) * 1e-9 - camera.phase_ms * 1e-3
        index = round(since_s * camera.fps)
        true_ns = self._epoch_ns + round(camera.exposure_middle_s(index) * 1e9)
        self._frames.append((message.camera, index, (message.t_ns - true_ns) / 1e3))

    def _take_status(self, sample: zenoh.Sample) -> None:
        message = decode(sample.payload.to_bytes(), CameraStatus)
        if message.clock_error_ms is not None:
            self._bounds.append(1e3 * message.clock_error_ms)

    def summarize(self) -> str:
        """RMS and largest error with the wand and with the robots, missing frames, and the reported bounds."""
        parts, wave_s = [], self._scene.wave_s
        for step, begin_s, end_s in (("wand", 0.0, wave_s), ("robots", wave_s, np.inf)):
            errors, missing = self._between(begin_s, end_s)
            rms, worst = np.sqrt(np.mean(np.square(errors))), np.abs(errors).max()
            parts.append(f"{step} {rms:.0f} RMS {worst:.0f} max us, {missing:.0%} of frames missing")
        median, worst = np.percentile(self._bounds, [50, 100])
        return f"timestamps: {'; '.join(parts)}; bound {median:.0f} median {worst:.0f} max us"

    def _between(self, begin_s: float, end_s: float) -> tuple[np.ndarray, float]:
        """Errors between two scene times, and the share of missing frames."""
        errors: list[float] = []
        expected = 0
        for name in self._scene.cameras:
            fps = self._scene.camera(name).fps
            own = {i: us for camera, i, us in self._frames if camera == name and begin_s <= i / fps < end_s}
            errors += own.values()
            expected += max(own) - min(own) + 1
        return np.array(errors), 1 - len(errors) / expected


def main(
    loops: int = 0,
    browser: bool = False,
    apart: bool = False,
    runs: int = 5,
    seconds: float = 10.0,
    seed: int = 7,
) -> None:
    """Print one line per run, then the position errors of the robots over all runs, and those over their claims.

    Args:
        loops: number of busy programs beside the demo.
        browser: open the page in a browser.
        apart: hide from the programs that they share a clock, so that they estimate the offset.
        runs: number of runs.
        seconds: duration of the tracking in each run.
        seed: of the first run's noise and lens errors; the next run has the next one.
    """
    if browser and CHROMIUM is None:
        sys.exit("chromium is not installed")
    if apart:
        os.environ["PYTHONPATH"] = str(Path(__file__).parent / "apart")
    errors: list[float] = []
    over_claims: dict[str, list[float]] = {}
    for k in range(seed, seed + runs):
        with interrupt_on_signals(), busy(loops), get_context("spawn").Pool(1) as process:
            text, timestamps = process.apply(play, (browser, seconds, k))
        print(f"seed {k}: {summarize_run(text)}; {timestamps}", flush=True)
        errors += positions_mm(text)
        for robot, ratio in re.findall(r"^(\w+): .* squared error over claim ([0-9.]+)", text, re.MULTILINE):
            over_claims.setdefault(robot, []).append(float(ratio))
    print(f"position error: median {np.median(errors):.2f}, max {max(errors):.2f} mm RMS")
    for robot, ratios in over_claims.items():
        each = " ".join(f"{x:.2f}" for x in ratios)
        print(f"{robot}: squared error over claim {np.mean(ratios):.2f} in the mean ({each})")


def positions_mm(text: str) -> list[float]:
    """RMS position errors of the robots in a demo's output, millimetres."""
    return [float(mm) for mm in re.findall(r"position ([0-9.]+|nan) mm RMS", text)]


def summarize_run(text: str) -> str:
    """Errors of robots and cameras, inflation and drifts in a demo's output."""
    cameras = re.search(r"position errors up to ([0-9.]+) mm", text)
    inflated = re.search(r"inflated by ([0-9.]+)", text)
    drifts = re.search(r"clock drift, ppm: (.*)", text)
    return (
        f"robots {' '.join(f'{x:.2f}' for x in positions_mm(text))} mm RMS; cameras {cameras and cameras[1]} mm; "
        f"inflated {inflated[1] if inflated else 'no'}; drifts {drifts[1] if drifts else 'none'}"
    )


def play(browser: bool, seconds: float, seed: int) -> tuple[str, str]:
    """Run the demo once; return its output with the log of its calibration, and the summary of its timestamps."""
    output, port = io.StringIO(), free_port()
    with (
        interrupt_on_signals(),
        tempfile.TemporaryDirectory() as folder,
        Demo(seeded_scene(Path(folder) / "scene", seed), Path(folder), ANY_PORT) as demo,
    ):
        errors = TimestampErrors(demo)
        with contextlib.redirect_stdout(output), browsing(port) if browser else contextlib.nullcontext():
            demo.run(("127.0.0.1", port) if browser else None, seconds)
        return output.getvalue() + (Path(folder) / "calib.log").read_text(), errors.summarize()


def seeded_scene(folder: Path, seed: int) -> Path:
    """A copy of the demo's scene, and of the files beside it, with another seed."""
    shutil.copytree(example_file("demo/scene.yaml").parent, folder)
    path = folder / "scene.yaml"
    path.write_text(re.sub(r"^seed: \d+$", f"seed: {seed}", path.read_text(), flags=re.MULTILINE))
    return path


@contextlib.contextmanager
def busy(loops: int) -> Iterator[None]:
    """Run busy programs."""
    programs = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(loops)]
    try:
        yield
    finally:
        end(programs)


@contextlib.contextmanager
def browsing(port: int) -> Iterator[None]:
    """Open the page in a browser as soon as it is served."""
    programs: list[subprocess.Popen] = []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        assert CHROMIUM is not None
        options = ["--headless=new", "--no-first-run", "--window-size=1000,700", STAY_OPEN]
        command = [CHROMIUM, *FLAGS, *options, f"--user-data-dir={profile}", f"http://127.0.0.1:{port}"]

        def open_page() -> None:
            wait_for_port(port)
            programs.append(subprocess.Popen(command, stderr=subprocess.DEVNULL))

        opener = threading.Thread(target=open_page)
        opener.start()
        try:
            yield
        finally:
            opener.join()
            end(programs)


def end(programs: list[subprocess.Popen]) -> None:
    """Stop programs and wait for them."""
    for program in programs:
        program.kill()
        program.wait()


if __name__ == "__main__":
    tyro.cli(main)
