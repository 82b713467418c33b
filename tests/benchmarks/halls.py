# SPDX-License-Identifier: BSD-3-Clause
"""How large an arena one server follows: `python -m tests.benchmarks.halls [--against CHECKOUT] [--large]`.

Prints the cost of a frame set in halls of different sizes, the age of poses when they are used, and the live start of a
server before 200 robots. Takes five minutes. With `--against`, each cost is measured in turns with that of another
checkout (with its environment in `.venv`), so that other programs affect both equally: compare the ratios.
"""

import json
import subprocess
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from camera_node.protocol.session import open_client
from fusion.client.arena import Arena
from fusion.protocol.pose_messages import RobotPose
from fusion.server.server import collecting_between_frame_sets
from tests.benchmarks.fusion_capacity import START_S, Capacity, Queue, capacity
from tests.benchmarks.fusion_load import START_NS, Load
from tests.benchmarks.fusion_server import ARENA, publish, serving
from tests.benchmarks.halls_load import Hall
from tests.conftest import free_port

ROOT = Path(__file__).resolve().parents[2]
SIZES = (8, 50), (8, 150), (16, 100)
LARGE = 64, 500
GROWTH = (8, 10), (32, 10)  # cameras at constant robots
USES = 1000  # times at which poses are used
DEADLINE_S = 60.0
Part = Literal["costs", "ages", "start"]


def main(
    part: Part | None = None,
    against: Path | None = None,
    large: bool = False,
    seconds: float = 2.0,
    rounds: int = 3,
    only: tuple[int, int] | None = None,
) -> None:
    """Print the tables.

    Args:
        part: of the benchmark; all without it.
        against: another checkout whose costs are measured in turns.
        large: also measure 64 cameras and 500 robots; takes two more minutes.
        seconds: of each load.
        rounds: of measurements; the least disturbed one counts.
        only: cameras and robots of one load, whose figures are printed as JSON.
    """
    if only is not None:
        print(json.dumps(asdict(capacity(Hall(cameras=only[0], robots=only[1]), seconds))))
        return
    console = Console(width=150)
    if part in (None, "costs"):
        sizes = (*SIZES, *GROWTH, *((LARGE,) if large else ()))
        console.print(_costs(sizes, seconds, rounds, against))
    if part in (None, "ages"):
        console.print(_ages(seconds))
    if part in (None, "start"):
        console.print(f"live start, 200 robots x 8 cameras at 30 Hz: {live_start(Load(200, 4, 8, 30.0))}")


def _costs(sizes: Sequence[tuple[int, int]], seconds: float, rounds: int, against: Path | None) -> Table:
    """Of a frame set at 60 Hz; each load in processes of its own."""
    checkouts = [ROOT, *([against.resolve()] if against else [])]
    got: dict[tuple[Path, tuple[int, int]], list[Capacity]] = {}
    for _ in range(rounds):
        for size in sizes:
            for checkout in checkouts:
                got.setdefault((checkout, size), []).append(_measure(checkout, size, seconds))
    best = {key: min(runs, key=lambda run: run.quiet_ms) for key, runs in got.items()}
    columns = "cameras x robots", "processor time, ms", "p50, p99 to the pose, ms", "tracked"
    table = Table(*columns, *(["of the other's time"] if against else []), title="a frame set at 60 Hz")
    for size in sizes:
        mine = best[ROOT, size]
        cells = [
            "{} x {}".format(*size),
            f"{mine.quiet_ms:.1f}",
            f"{mine.p50_ms:.1f}, {mine.p99_ms:.1f}",
            f"{mine.tracked:.1%}",
        ]
        if against:
            cells.append(f"{mine.quiet_ms / best[checkouts[1], size].quiet_ms:.2f}")
        table.add_row(*cells)
    (few, robots), (many, _) = GROWTH
    growth = (best[ROOT, GROWTH[1]].quiet_ms - best[ROOT, GROWTH[0]].quiet_ms) / (many - few)
    table.caption = f"5th percentile; {growth:.3f} ms for each further camera at {robots} robots"
    return table


def _measure(checkout: Path, size: tuple[int, int], seconds: float) -> Capacity:
    """A load by the programs of a checkout, in a process."""
    command = [checkout / ".venv/bin/python", "-m", "tests.benchmarks.halls", "--seconds", str(seconds)]
    done = subprocess.run(
        [*command, "--only", *map(str, size)], cwd=checkout, check=True, capture_output=True, text=True
    )
    return Capacity(**json.loads(done.stdout.splitlines()[-1]))


@dataclass(frozen=True)
class Use:
    """Poses as a program uses them at random times: the median age of their evidence, RMS errors, metres, and the share
    of a core that frame sets take."""

    age_ms: float
    error_m: float
    core: float


def use_of_poses(load: Load, seconds: float, rate_hz: float) -> Use:
    """The last published poses of so many frame sets a second, extrapolated with their velocities to random times; see
    `Queue`."""
    published: list[tuple[int, Sequence[RobotPose]]] = []
    with collecting_between_frame_sets():
        queue = Queue(
            load, seconds, rate_hz=rate_hz, use=lambda at_ns, poses: published.append((at_ns, poses))
        )
        for message in load.messages(seconds):
            queue.step(message, message.t_ns + 5_000_000)
    at_ns = np.array([at for at, _ in published])
    span_s = np.random.default_rng(0).uniform(START_S + 4 / load.hz, seconds - 2 / load.hz, USES)
    names = {name: k for k, name in enumerate(load.bodies)}
    ages_s, errors_m2 = [], []
    for s in span_s.tolist():
        now_ns = START_NS + round(s * 1e9)
        truth = load.paths.at(s).p
        for pose in published[int(np.searchsorted(at_ns, now_ns)) - 1][1]:
            age_s = (now_ns - pose.t_ns) * 1e-9
            ages_s.append(age_s + pose.evidence_age_s)
            p = np.array(pose.position) + age_s * np.array(pose.velocity)
            errors_m2.append(float(((p - truth[names[pose.robot]]) ** 2).sum()))
    return Use(1e3 * float(np.median(ages_s)), float(np.mean(errors_m2)) ** 0.5, queue.sum_up(seconds).cpu)


def _ages(seconds: float) -> Table:
    table = Table(
        "rate",
        "frame sets a second",
        "age at use",
        "error after extrapolation",
        "processor time",
        title="20 robots at 1 m/s on curves of 0.25 m, 8 cameras",
    )
    for hz, times in product((60.0, 30.0), (1, 2, 4)):
        got = use_of_poses(Load(20, 4, 8, hz), seconds, times * hz)
        error, core = f"{1e3 * got.error_m:.2f} mm RMS", f"{got.core:.0%} of a core"
        table.add_row(f"{hz:g} Hz", f"{times * hz:g}", f"{got.age_ms:.1f} ms", error, core)
    return table


def live_start(load: Load, seconds: float = 20.0) -> str:
    """How long a server in a process of its own takes to track robots that other processes' detections show."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with (
        TemporaryDirectory() as folder,
        serving(load, Path(folder), endpoint),
        Arena.connect(endpoint, arena=ARENA) as arena,
        open_client([endpoint], timeout_s=DEADLINE_S) as session,
    ):
        arena.status(DEADLINE_S).next(DEADLINE_S)
        tracked: dict[str, bool] = {}
        most, begun_s, all_s = 0, None, None

        def count(poses: Sequence[RobotPose]) -> None:
            nonlocal most, all_s
            tracked.update({pose.robot: pose.state == "tracked" for pose in poses})
            most = max(most, sum(tracked.values()))
            if most == load.robots and all_s is None:
                all_s = time.monotonic()

        arena.pose_sets().on_message(count)
        for sent_s in publish(load, session, seconds):
            begun_s = begun_s or time.monotonic() - sent_s
            if all_s is not None:
                return f"all tracked after {all_s - begun_s:.1f} s"
    return f"at most {most} of {load.robots} tracked in {seconds:g} s"


if __name__ == "__main__":
    tyro.cli(main)
