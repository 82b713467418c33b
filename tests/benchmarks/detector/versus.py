# SPDX-License-Identifier: BSD-3-Clause
"""Time of this checkout's detector over another's, in turns: `python -m tests.benchmarks.detector.versus CHECKOUT`.

Both run in processes of their own, each with its checkout's `.venv`, and take turns of a tenth of a second on the same
pictures. Their ratio is that of the builds on a loaded machine, too, which single times are not.
"""

import pickle
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from tests.benchmarks.detector.pictures import NOISE, F, Grey, dead_leaves, expose, flat, paste
from tests.benchmarks.detector.speed import SIZES, place_cards, walk
from tests.benchmarks.detector.table import table

HERE = Path(__file__).resolve().parents[3]
LIMIT = 1.10
TRACKED_FRAMES = 16

# Runs in either checkout: for each line read, times one case for a tenth of a second.
WORKER = """
import pickle, sys, time
sys.path.insert(0, '')
from itertools import cycle
from camera_node.detection.detector import Detector
cases = pickle.load(open(sys.argv[1], 'rb'))
running = {}
def cold(image):
    detector = Detector()
    start = time.thread_time_ns()
    detector.detect(image)
    return time.thread_time_ns() - start
def tracked(name, frames):
    if name not in running:
        running[name] = Detector(), cycle([*frames, *frames[-2:0:-1]])
        for _ in range(64): running[name][0].detect(next(running[name][1]))
    detector, turns = running[name]
    start = time.thread_time_ns()
    for _ in range(16): detector.detect(next(turns))
    return (time.thread_time_ns() - start) / 16
for line in sys.stdin:
    name, times, end = line.strip(), [], time.perf_counter() + 0.1
    while time.perf_counter() < end or len(times) < 3:
        frames = cases[name]
        times.append(cold(frames[0]) if len(frames) == 1 else tracked(name, frames))
    print(sorted(times)[len(times) // 4], flush=True)
"""


def cold_cases(counts: tuple[int, ...]) -> dict[str, list[Grey]]:
    """The first frames of the part `speed`, in clutter."""
    cases = {}
    for size in SIZES:
        for count in counts:
            rng = np.random.default_rng((size[0], count))
            ground = dead_leaves(size, rng)
            cards = place_cards(count, size, rng)
            image = paste(ground, cards, focal=F * size[1] / 640)
            cases[f"{size[0]} lines, {count} markers"] = [
                expose(image, NOISE, np.random.default_rng(count)),
            ]
    return cases


def tracked_cases() -> dict[str, list[Grey]]:
    """Frames of 50 markers of 20 px that turn back in every frame and after five, on an even ground."""
    cases, size = {}, (480, 640)
    there = place_cards(50, size, np.random.default_rng(5), 20.0)
    for steps in (2, 6):
        rng = np.random.default_rng(len(there))
        frames = [expose(paste(flat(size, 128.0), cards), NOISE, rng) for cards in walk(there, steps)]
        cases[f"50 markers tracked, turning after {steps - 1}"] = frames
    return cases


class Worker:
    """A process that times one checkout's detector on request."""

    def __init__(self, checkout: Path, cases: Path) -> None:
        python = checkout / ".venv/bin/python"
        command = [str(python if python.exists() else sys.executable), "-c", WORKER, str(cases)]
        self._process = subprocess.Popen(
            command, cwd=checkout, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def measure(self, name: str) -> float:
        """Milliseconds of a call, the first quartile of a tenth of a second."""
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.write(name + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise SystemExit(f"the detector in {self._process.args} ended; is that checkout built?")
        return float(answer) / 1e6

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin
        self._process.stdin.close()
        self._process.wait(10)


@dataclass(frozen=True)
class Versus:
    """Measure this checkout's detector against that of another checkout of this repository."""

    checkout: Annotated[Path, tyro.conf.Positional]
    """The folder of the other checkout, built, with its own `.venv`."""
    seconds: float = 3.0
    """Duration of each case."""
    counts: tuple[int, ...] = (0, 50)
    """Numbers of markers in the first frames."""

    def run(self) -> None:
        """Print the ratio of each case: the median over all turns."""
        cases = cold_cases(self.counts) | tracked_cases()
        with tempfile.NamedTemporaryFile(suffix=".pickle") as file:
            Path(file.name).write_bytes(pickle.dumps(cases))
            ours, theirs = Worker(HERE, Path(file.name)), Worker(self.checkout, Path(file.name))
            try:
                rows = [self._row(name, ours, theirs) for name in cases]
            finally:
                ours.close()
                theirs.close()
        Console().print(table("this checkout over the other", ("case", "ms", "other ms", "ratio"), rows))

    def _row(self, name: str, ours: Worker, theirs: Worker) -> tuple[str, ...]:
        times, end = [], time.perf_counter() + self.seconds
        while time.perf_counter() < end or len(times) < 5:
            times.append((ours.measure(name), theirs.measure(name)))
        us, them = np.array(times).T
        ratio = float(np.median(us / them))
        return name, f"{us.min():.3f}", f"{them.min():.3f}", f"{ratio:.3f}{'' if ratio <= LIMIT else ' !'}"


if __name__ == "__main__":
    tyro.cli(Versus, prog="tests.benchmarks.detector.versus").run()
