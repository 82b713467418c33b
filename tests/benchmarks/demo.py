# SPDX-License-Identifier: BSD-3-Clause
"""The demo beside other work: by how much stamps are off, and what poses that gives.

`python -m tests.benchmarks.demo [--browser] [--loops 3] [--apart] [--runs 5]`. All programs are real and share one
clock, so that a stamp should be the middle of its exposure to the nanosecond; what it is off is its node's doing.
"""

import contextlib
import io
import os
import re
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

from camera_node.protocol.messages import CameraStatus, Detections, decode
from camera_node.simulation.scene import Scene
from tests.conftest import free_port, wait_for_port
from tests.web.test_view import CHROMIUM, FLAGS
from web.demo import Demo, default_scene
from web.processes import Processes, ended_by_signals

BUSY = "while True: pass"
STAYS = "--remote-debugging-port=0"  # until it is stopped


class Stamps:
    """What stamps of a demo's frames are off, microseconds, and what the cameras claim of it."""

    def __init__(self, demo: Demo) -> None:
        self._scene, self._epoch_ns = demo.scene, demo.epoch_ns
        self._frames: list[tuple[str, int, float]] = []  # camera, exposure, microseconds off
        self._claimed: list[float] = []
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
            self._claimed.append(1e3 * message.clock_error_ms)

    def summarise(self) -> str:
        """RMS and worst while the wand is waved and after, exposures that are missing, and the bound as it was told."""
        parts, wave_s = [], self._scene.wave_s
        for what, begin_s, end_s in (("wave", 0.0, wave_s), ("robots", wave_s, np.inf)):
            off, missing = self._during(begin_s, end_s)
            rms, worst = np.sqrt(np.mean(np.square(off))), np.abs(off).max()
            parts.append(f"{what} {rms:.0f} RMS {worst:.0f} max us, {missing:.0%} of frames missing")
        median, worst = np.percentile(self._claimed, [50, 100])
        return f"stamps: {'; '.join(parts)}; bound {median:.0f} median {worst:.0f} max us"

    def _during(self, begin_s: float, end_s: float) -> tuple[np.ndarray, float]:
        off: list[float] = []
        due = 0
        for name in self._scene.cameras:
            fps = self._scene.camera(name).fps
            mine = {i: us for camera, i, us in self._frames if camera == name and begin_s <= i / fps < end_s}
            off += mine.values()
            due += max(mine) - min(mine) + 1
        return np.array(off), 1 - len(off) / due


def main(
    loops: int = 0, browser: bool = False, apart: bool = False, runs: int = 5, seconds: float = 10.0
) -> None:
    """Print a line a run, then how far robots were off in all of them.

    Args:
        loops: programs that are busy all the while.
        browser: whether a browser shows the page.
        apart: programs are not told that they share a clock, and estimate it as on machines of their own.
        runs: of the demo.
        seconds: that robots are followed in each.
    """
    if browser and CHROMIUM is None:
        sys.exit("chromium is not installed")
    if apart:
        os.environ["PYTHONPATH"] = str(Path(__file__).parent / "apart")
    errors: list[float] = []
    for run in range(runs):
        # In a process of its own, as a demo times how long its own took to come up.
        with ended_by_signals(), busy(loops), get_context("spawn").Pool(1) as process:
            told, stamps = process.apply(play, (browser, seconds))
        mm = [float(text) for text in re.findall(r"position ([0-9.]+|nan) mm RMS", told)]
        errors += mm
        placed = re.search(r"([0-9.]+) mm from their true places", told)
        widened = re.search(r"taken ([0-9.]+) times as large", told)
        drifts = re.search(r"clocks drift apart, in ppm: (.*)", told)
        print(
            f"{run + 1}: robots {' '.join(f'{x:.2f}' for x in mm)} mm RMS; cameras {placed and placed[1]} mm; "
            f"widened {widened[1] if widened else 'no'}; drifts {drifts[1] if drifts else 'none'}; {stamps}",
            flush=True,
        )
    print(f"robots off: median {np.median(errors):.2f}, most {max(errors):.2f} mm RMS")


def play(browser: bool, seconds: float) -> tuple[str, str]:
    """One demo: what it and its calibration said, and what its stamps were off."""
    path, said, port = default_scene(), io.StringIO(), free_port()
    with (
        ended_by_signals(),
        tempfile.TemporaryDirectory() as folder,
        Processes(Path(folder)) as processes,
    ):
        demo = Demo(Scene.load(path), path.parent, processes, f"tcp/127.0.0.1:{free_port()}")
        stamps = Stamps(demo)
        with contextlib.redirect_stdout(said), browsing(port) if browser else contextlib.nullcontext():
            demo.play(("127.0.0.1", port) if browser else None, seconds)
        told = said.getvalue() + (Path(folder) / "calib.log").read_text()
        return told, stamps.summarise()


@contextlib.contextmanager
def busy(loops: int) -> Iterator[None]:
    """Other work of the machine."""
    programs = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(loops)]
    try:
        yield
    finally:
        end(programs)


@contextlib.contextmanager
def browsing(port: int) -> Iterator[None]:
    """A browser on the page, as soon as it is served."""
    programs: list[subprocess.Popen] = []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        assert CHROMIUM is not None
        options = ["--headless=new", "--no-first-run", "--window-size=1000,700", STAYS]
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
