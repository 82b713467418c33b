# SPDX-License-Identifier: BSD-3-Clause
"""Measures codes: `python -m tests.benchmarks.codes`.

Of cards in pictures: shares of certain names, wrong names, headings, false names. Of 60 identical robots that cross,
are covered and exchanged (`--part robots`): poses of another robot, and those that are missing. Of one roundel
(`--part reading`): microseconds of a read.
"""

import subprocess
import tempfile
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from rich.console import Console

from camera_node.detection.detector import Detector
from camera_node.detection.roundels import Roundels
from camera_node.foundation.arrays import Array
from camera_node.geometry import codes
from camera_node.geometry.pose import rotation_from_vector
from camera_node.simulation.sensor import SENSORS, SensorName
from fusion.model.robots import Robot
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.named_markers import MIN_VIEWS
from fusion.tracking.tracker import Tracker
from tests.benchmarks.detector.negatives import clutter, letters, text_pages
from tests.benchmarks.detector.photographs import photographs
from tests.benchmarks.detector.pictures import Card, grid, missed, paste, rotation_of
from tests.benchmarks.detector.recall import SIZE, ground
from tests.benchmarks.detector.table import table
from tests.conftest import ROOT
from tests.fusion.synthetic import PERIOD_NS, Arena, ring
from tests.native import build

CELLS = {0: (11, 12, 14, 16, 20), 45: (12, 14, 16, 20), 60: (14, 16, 20, 24)}  # diameters by tilt, degrees
FRAMES = (1, 10)
ROBOTS, CAMERAS = 60, 8
DIAMETER_M = 0.08
UNSEEN, UNREAD = 0.1, 0.2  # shares of the views that are not detected, and of the detections without a name
HIDDEN_S, PERIOD_S = 0.5, 2.0  # how long a robot is covered, and how often
WRONG_M = 0.05  # of a pose of another robot
WITHIN_S = 0.2  # goal of the acquisition after two cameras see a robot
FAST = ("-O3", "-UROUNDEL_SCALAR")  # as the module is compiled
NEAR = 0.2  # distance from the true centre at which a card counts as found, diameters


@dataclass
class Count:
    """Of cards: found, named, wrongly named; errors and claims of headings, radians."""

    shown: int = 0
    found: int = 0
    named: int = 0
    wrong: int = 0
    errors: list[float] = field(default_factory=list)
    sigmas: list[float] = field(default_factory=list)

    def row(self) -> tuple[str, ...]:
        """Percentages of cards, wrong names, RMS of headings and of their claims in degrees."""
        rms = (
            np.degrees(np.sqrt(np.mean(np.square(x)))) if x else np.nan for x in (self.errors, self.sigmas)
        )
        shares = (100 * n / self.shown for n in (self.found, self.named))
        return *(f"{x:.1f}" for x in shares), str(self.wrong), *(f"{x:.2f}" for x in rms)


def cards(diameter: float, tilt_deg: float, count: int, rng: np.random.Generator) -> list[Card]:
    """Cards with random codes, turns and directions of tilt."""
    return [
        Card(
            uv,
            diameter,
            float(np.radians(tilt_deg)),
            float(rng.uniform(0, 2 * np.pi)),
            card=codes.CARD,
            code=int(rng.integers(1, len(codes.words()) + 1)),
            spin=float(rng.uniform(0, 2 * np.pi)),
        )
        for uv in grid(count, SIZE, rng)
    ]


def compare(
    image_cards: list[Card], detector: Detector, light: Array, camera: SensorName, frames: int
) -> Count:
    """Detect the cards in so many pictures of the same light, and judge the last one."""
    rng = np.random.default_rng(len(image_cards))
    found = detector.detect(SENSORS[camera].expose(light, rng))
    for _ in range(frames - 1):
        found = detector.detect(SENSORS[camera].expose(light, rng))
    count = Count(len(image_cards), len(image_cards) - missed(image_cards, found.uv))
    for card in image_cards:
        apart = np.linalg.norm(found.uv - card.uv, axis=1)
        if not apart.min(initial=np.inf) < NEAR * card.diameter:
            continue
        roundel = found[int(apart.argmin())]
        if roundel.id is None:
            continue
        count.named += 1
        count.wrong += roundel.id != card.code
        if np.isfinite(roundel.rotation_rad):
            off = roundel.rotation_rad - rotation_of(card, SIZE)
            count.errors.append(float((off + np.pi) % (2 * np.pi) - np.pi))
            count.sigmas.append(roundel.rotation_sigma)
    return count


@dataclass(frozen=True)
class Crossing:
    """The places of identical robots on Lissajous figures through the arena.

    Each is covered in a part of each period, together with another one; in the middle of it, the two change places.
    """

    rate: Array
    phase: Array
    begin_s: Array

    @classmethod
    def of(cls, rng: np.random.Generator) -> "Crossing":
        """Random ones; two robots at a time are covered together, and exchanged in every other period."""
        pairs = np.repeat(rng.uniform(0.3, PERIOD_S - HIDDEN_S, ROBOTS // 2), 2)
        return cls(rng.uniform(0.3, 0.7, (ROBOTS, 2)), rng.uniform(0, 2 * np.pi, (ROBOTS, 2)), pairs)

    def is_covered(self, k: int, t: float) -> bool:
        """Whether no camera sees robot k."""
        return 0 <= t % PERIOD_S - self.begin_s[k] < HIDDEN_S

    def place(self, k: int, t: float) -> tuple[Array, Array]:
        """R (3, 3) and p (3,) of robot k, which drives along its figure, or along that of the other one of its pair."""
        ended = (
            int((t - self.begin_s[k] - HIDDEN_S / 2) // PERIOD_S) + 1
        )  # covers that have passed their middle
        k = k ^ 1 if ended % 2 else k
        at = self.rate[k] * t + self.phase[k]
        x, y = 1.3 * np.sin(at)
        heading = np.arctan2(*(self.rate[k] * np.cos(at))[::-1])
        return rotation_from_vector([0.0, 0.0, heading]), np.array([x, y, 0.1 + 0.01 * (k % 10)])


def crossing_robots(seconds: float, seed: int = 1) -> tuple[str, ...]:
    """Track the robots; a row of the table."""
    rng = np.random.default_rng(seed)
    crossing = Crossing.of(rng)
    names = [f"r{k}" for k in range(ROBOTS)]
    robots = {name: Robot(diameter_m=DIAMETER_M, code=k + 1) for k, name in enumerate(names)}
    motions = {name: partial(crossing.place, k) for k, name in enumerate(names)}
    arena = Arena(
        robots,
        motions,
        ring(CAMERAS),
        tuple(rng.uniform(-0.45, 0.45, CAMERAS)),
        sigma_px=0.1,
        hidden=lambda name, _, t: crossing.is_covered(int(name[1:]), t) or rng.uniform() < UNSEEN,
    )
    tracker, synchronizer = Tracker(arena.cameras, robots), FrameSynchronizer(PERIOD_NS)
    for frame in arena.frames(round(seconds * 1e9 / PERIOD_NS)):
        synchronizer.add(replace(frame, roundels=_partly_read(frame.roundels, rng)))
    shown = tracked = wrong = late = 0
    since = np.full(ROBOTS, np.inf)
    for frame_set in synchronizer.finish():
        t = arena.seconds(frame_set.t_ns)
        result = tracker.track(frame_set)
        poses = {pose.robot: pose for pose in result.poses if pose.state == "tracked"}
        views = Counter(code for frame in frame_set.frames for code in set(frame.roundels.id.tolist()))
        for k, name in enumerate(names):
            since[k] = min(since[k], t) if views[k + 1] >= MIN_VIEWS else np.inf
            if name in poses:
                off = np.linalg.norm(np.array(poses[name].position) - crossing.place(k, t)[1])
                wrong += bool(off > WRONG_M and not crossing.is_covered(k, t))
            if t - since[k] > WITHIN_S:
                shown, tracked = shown + 1, tracked + (name in poses)
                late += name not in poses
    return str(shown), f"{100 * tracked / shown:.2f}", str(wrong), str(late)


def _partly_read(roundels: Roundels, rng: np.random.Generator) -> Roundels:
    """The roundels, some without a name."""
    unread = rng.uniform(size=len(roundels)) < UNREAD
    unknown = {
        name: np.where(unread, np.nan, getattr(roundels, name))
        for name in ("id_probability", "rotation_rad", "rotation_sigma")
    }
    return replace(roundels, id=np.where(unread, -1, roundels.id).astype(np.int32), **unknown)


def reading_times() -> list[tuple[str, ...]]:
    """Microseconds in which one code is read, by diameter and kind of roundel."""
    driver = Path(__file__).with_name("code_reading.cpp")
    with tempfile.TemporaryDirectory() as folder:
        native = ROOT / "camera_node" / "native"
        program = build(native, driver, Path(folder), ("code_book", "code_reader"), FAST)
        done = subprocess.run([program], capture_output=True, check=True, text=True, timeout=60)
    return [tuple(line.split()) for line in done.stdout.splitlines()]


@dataclass(frozen=True)
class Benchmark:
    """Measure codes on clutter, by tilt, diameter and number of frames, and false names without codes."""

    camera: SensorName = "mild"
    """clean, mild or harsh."""
    count: int = 96
    """Cards of a cell, 48 in a picture."""
    pictures: int = 200
    """Pictures without codes of each kind."""
    part: Literal["pictures", "robots", "reading"] | None = None
    """Of the benchmark; all without it."""
    seconds: float = 8.0
    """Of the robots that cross."""

    def run(self) -> None:
        """Print the tables."""
        console = Console(width=120)
        if self.part in (None, "pictures"):
            self._read_pictures(console)
        if self.part in (None, "reading"):
            headings = ("diameter, px", "coded", "plain", "plain, on tiles")
            console.print(table("microseconds of a read", headings, reading_times()))
        if self.part in (None, "robots"):
            headings = ("robots seen for 0.2 s", "% tracked", "poses of another", "missing")
            console.print(table("60 identical robots", headings, [crossing_robots(self.seconds)]))

    def _read_pictures(self, console: Console) -> None:
        rows = []
        for tilt, diameters in CELLS.items():
            for diameter in diameters:
                for frames in FRAMES:
                    total = self._cell(diameter, tilt, frames)
                    rows.append((f"{tilt} degrees, {diameter} px, {frames} frames", *total.row()))
                    console.print(*rows[-1])
        headings = ("", "% found", "% named", "wrong", "heading, deg", "claimed")
        console.print(table(f"{self.camera} camera, on clutter", headings, rows))
        rows = []
        for name, kind in (
            ("photographs", photographs),
            ("dead leaves", clutter),
            ("letters", letters),
            ("pages of text", text_pages),
        ):
            found = named = shown = 0
            for image in kind(self.pictures):
                seen = Detector().detect(image)
                shown, found, named = shown + 1, found + len(seen), named + int((seen.id > 0).sum())
            rows.append((name, str(shown), str(found), str(named)))
        console.print(table("without codes", ("", "pictures", "roundels", "names"), rows))

    def _cell(self, diameter: float, tilt: float, frames: int) -> Count:
        total = Count()
        for seed in range(max(1, self.count // 48)):
            rng = np.random.default_rng((seed, int(diameter), int(tilt)))
            shown = cards(diameter, tilt, 48, rng)
            one = compare(shown, Detector(), paste(ground("clutter", rng), shown), self.camera, frames)
            total = Count(*(getattr(total, name) + getattr(one, name) for name in Count.__dataclass_fields__))
        return total


if __name__ == "__main__":
    tyro.cli(Benchmark, prog="tests.benchmarks.codes").run()
