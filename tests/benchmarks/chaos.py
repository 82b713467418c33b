# SPDX-License-Identifier: BSD-3-Clause
"""Random faults every few seconds: `python -m tests.benchmarks.chaos [--minutes 30] [--seed 1] [--virtual]`.

Server, four cameras at 30 Hz, viewer, page, recorder, client and a node that renders its images run as processes and
follow ten robots. Nothing may crash, every fault is reported, and poses are right and without unexplained gaps.
"""

import random
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tyro
from rich.table import Table

from camera_node.terminal import console, say, track
from tests.benchmarks.faults.arena import LiveArena, small_load
from tests.benchmarks.faults.judge import Gap, WrongPose
from tests.benchmarks.faults.kinds import KINDS, LONGEST_S, SHORT_S, VIRTUAL, Fault
from tests.benchmarks.faults.memory import Growth
from tests.benchmarks.faults.reports import Evidence
from tests.benchmarks.faults.virtual_arena import VirtualArena
from tests.benchmarks.fuzz import EXTRA

PAUSE_S = 0.5, 3.0  # between two faults
SETTLE_S = 3.0  # after a fault, in which a gap is explained by it and its report counts
STEP_S = 0.05  # between two looks at logs and status
WAITS_S = 0.2  # between two looks at how long threads waited for a processor
CLOCK_S = 0.1  # after a step of a camera's clock, in which poses may be wrong


@dataclass
class Episode:
    """A fault that was caused: when, by the monotonic clock, and how it was reported."""

    kind: str
    fault: Fault
    begun_s: float
    ended_s: float = 0.0
    reported_s: float | None = None
    report: str = ""

    def explains(self, gap: Gap) -> bool:
        """Whether a gap is at the time of this fault, and not longer than such a fault may cause."""
        during = gap.from_s < self.ended_s + SETTLE_S and gap.until_s > self.begun_s
        return during and self.fault.robots in (None, (gap.robot,)) and gap.seconds <= self.fault.gap_s

    def excuses(self, pose: WrongPose) -> bool:
        """Whether a camera's clock was stepped, or stepped back, just now; the end of a drift is a step."""
        steps_s = {"clock stepped": (self.begun_s, self.ended_s), "clock drifts": (self.ended_s,)}
        return any(0 <= pose.received_s - at_s < CLOCK_S for at_s in steps_s.get(self.kind, ()))


@dataclass
class ChaosResult:
    """What happened in a run.

    Attributes:
        episodes: all faults.
        gaps: in the poses of visible robots, above `SHORT_S`; `waits_s` is for how long the machine let some
            thread wait for a processor during it.
        wrong: poses that are not excused.
        growths: of the memory of each program, over all its lives.
    """

    episodes: list[Episode] = field(default_factory=list)
    gaps: list[Gap] = field(default_factory=list)
    waits_s: dict[Gap, float] = field(default_factory=dict)
    wrong: list[WrongPose] = field(default_factory=list)
    crashes: list[str] = field(default_factory=list)
    growths: dict[str, Growth] = field(default_factory=dict)
    poses: int = 0
    rms_m: float = 0.0

    def unexplained(self) -> list[Gap]:
        """Gaps that no fault explains, nor a lack of processors."""
        return [
            gap
            for gap in self.gaps
            if not any(episode.explains(gap) for episode in self.episodes)
            and gap.seconds - self.waits_s.get(gap, 0.0) > SHORT_S
        ]

    def unreported(self) -> list[Episode]:
        """Faults that somebody had to report."""
        return [e for e in self.episodes if e.fault.report is not None and e.reported_s is None]

    def longest(self) -> list[Gap]:
        """Gaps above the limit for any fault; a server that starts needs its time."""
        return [
            gap
            for gap in self.gaps
            if gap.seconds > LONGEST_S
            and not any(e.kind == "server killed" and e.explains(gap) for e in self.episodes)
        ]

    def failures(self) -> list[str]:
        """What does not hold, one line each."""
        return [
            *(f"crash: {crash}" for crash in self.crashes),
            *(f"not reported: {e.kind} of {e.fault.target}" for e in self.unreported()),
            *(self._describe(gap, "unexplained gap") for gap in self.unexplained()),
            *(self._describe(gap, "long gap") for gap in self.longest()),
            *self._describe_wrong(),
            *(f"{name} grows by {growth}" for name, growth in self.growths.items() if growth.is_excessive),
        ]

    def _describe(self, gap: Gap, what: str) -> str:
        waited = self.waits_s.get(gap, 0.0)
        return (
            f"{what} of {gap.robot}: {gap.seconds:.2f} s (waited {waited:.2f} s), {self._context(gap.from_s)}"
        )

    def _describe_wrong(self) -> Iterator[str]:
        """One line for the wrong poses after each fault."""
        groups: dict[str, list[WrongPose]] = defaultdict(list)
        for pose in self.wrong:
            groups[self._context(pose.received_s).partition(" after ")[2]].append(pose)
        for context, poses in groups.items():
            error_mm = 1e3 * max(pose.error_m for pose in poses)
            seconds = poses[-1].received_s - poses[0].received_s
            yield f"{len(poses)} poses up to {error_mm:.0f} mm off within {seconds:.1f} s after {context}"

    def _context(self, at_s: float) -> str:
        """The last fault before a moment."""
        before = [e for e in self.episodes if e.begun_s <= at_s]
        if not before:
            return "0 s after the start"
        return f"{at_s - before[-1].begun_s:.1f} s after {before[-1].kind} of {before[-1].fault.target}"


class Chaos:
    """Causes faults in a running arena, one after the other.

    Args:
        arena: it runs.
        rng: chooses kinds and targets.
        kinds: the names of the kinds to choose from.
    """

    def __init__(self, arena: LiveArena | VirtualArena, rng: random.Random, kinds: Sequence[str]) -> None:
        self.arena, self.rng, self.kinds = arena, rng, kinds
        self.result = ChaosResult()
        self._waits: list[tuple[float, dict[str, float]]] = []

    def run(self, seconds: float) -> Iterator[float]:
        """Cause faults for a time; yields the seconds since the start after each."""
        begun_s = self.arena.clock.now_s()
        order: list[str] = []
        while (elapsed_s := self.arena.clock.now_s() - begun_s) < seconds:
            order = order or self._shuffled()
            self._cause(order.pop())
            yield elapsed_s
        self._look(None, SETTLE_S)
        self._conclude()

    def _shuffled(self) -> list[str]:
        """All kinds by their weights, in random order: each occurs early."""
        names = [name for name in self.kinds for _ in range(KINDS[name][0])]
        self.rng.shuffle(names)
        return names

    def _cause(self, kind: str) -> None:
        arena, clock = self.arena, self.arena.clock
        fault = KINDS[kind][1](arena, self.rng)  # pyright: ignore[reportArgumentType] virtual: see VIRTUAL
        counted = dict(arena.status.faults) if arena.status else {}
        evidence = Evidence(arena, counted=counted, begun_ns=clock.now_ns())  # pyright: ignore[reportArgumentType]
        episode = Episode(kind, fault, clock.now_s(), clock.now_s() + fault.seconds)
        self.result.episodes.append(episode)
        fault.begin()
        self._look((episode, evidence), fault.seconds)
        fault.end()
        episode.ended_s = clock.now_s()
        self._look((episode, evidence), self.rng.uniform(*PAUSE_S))

    def _look(self, current: tuple[Episode, Evidence] | None, seconds: float) -> None:
        """Follow logs and status for a time."""
        arena, now_s = self.arena, self.arena.clock.now_s
        end_s, next_s, waits_s = now_s() + seconds, 0.0, 0.0
        while now_s() < end_s:
            arena.wait(STEP_S)
            lines = [f"{program}: {line}" for program, line in arena.new_lines()]
            if current and current[0].fault.report and current[0].reported_s is None:
                episode, evidence = current
                evidence.lines += lines
                if report := current[0].fault.report(evidence):
                    episode.reported_s, episode.report = now_s(), report
            if now_s() > waits_s:
                self._waits.append((now_s(), arena.waited_s()))
                waits_s = now_s() + WAITS_S
            arena.inspect(samples_memory=now_s() > next_s)
            if now_s() > next_s:
                next_s = now_s() + 1.0
            self._note_gaps()

    def _note_gaps(self) -> None:
        """Compute the waits of new gaps while the samples are recent."""
        gaps, self.arena.judge.gaps[:] = self.arena.judge.gaps[:], []
        for gap in gaps:
            self.result.gaps.append(gap)
            self.result.waits_s[gap] = self._waited_s(gap)
        del self._waits[:-200]

    def _waited_s(self, gap: Gap) -> float:
        """For how long the thread that waited longest for a processor did so around a gap."""
        around = 2 * WAITS_S
        inside = [w for at_s, w in self._waits if gap.from_s - around < at_s < gap.until_s + around]
        if len(inside) < 2:
            return 0.0
        names = inside[0].keys() & inside[-1].keys()
        return max((inside[-1][name] - inside[0][name] for name in names), default=0.0)

    def _conclude(self) -> None:
        judge, result = self.arena.judge, self.result
        judge.close_gaps()
        self._note_gaps()
        result.wrong = [pose for pose in judge.wrong if not any(e.excuses(pose) for e in result.episodes)]
        result.poses, result.rms_m = judge.count, judge.rms_m


def chaos(
    folder: Path, seconds: float, seed: int, kinds: Sequence[str] = tuple(KINDS)
) -> Iterator[float | ChaosResult]:
    """Run an arena and cause faults; yields the seconds since the start, then the result."""
    with LiveArena(folder, small_load(), EXTRA) as arena:
        arena.wait_until_tracked()
        arena.wait(SETTLE_S)
        arena.judge.forget()
        arena.programs.new_lines()
        run = Chaos(arena, random.Random(seed), kinds)
        yield from run.run(seconds)
    run.result.crashes = arena.programs.crashes
    run.result.growths = arena.programs.growths()
    yield run.result


def virtual_chaos(
    folder: Path, seconds: float, seed: int, kinds: Sequence[str] = VIRTUAL
) -> Iterator[float | ChaosResult]:
    """The same in virtual time; the kinds are faults of cameras and robots."""
    with VirtualArena(folder, small_load(), seed) as arena:
        arena.wait(2 * SETTLE_S)
        arena.judge.forget()
        arena.new_lines()
        run = Chaos(arena, random.Random(seed), kinds)
        yield from run.run(seconds)
    yield run.result


def main(
    minutes: float = 30.0, seed: int = 1, kinds: tuple[str, ...] = tuple(KINDS), virtual: bool = False
) -> int:
    """Print what each kind of fault caused and who reported it; exit code 1 if something does not hold.

    Args:
        minutes: how long.
        seed: of the choices.
        kinds: of faults.
        virtual: in virtual time, without network and processes; of the kinds those of cameras and robots.
    """
    result = ChaosResult()
    if virtual:
        kinds = tuple(kind for kind in kinds if kind in VIRTUAL)
    with tempfile.TemporaryDirectory(prefix="roundel-chaos-") as folder:
        run = virtual_chaos if virtual else chaos
        for step in track(run(Path(folder), 60 * minutes, seed, kinds), "chaos"):
            if isinstance(step, ChaosResult):
                result = step
    report(result)
    return int(bool(result.failures()))


def report(result: ChaosResult) -> None:
    """Print the result."""
    rows: dict[str, list[Episode]] = defaultdict(list)
    for episode in result.episodes:
        rows[episode.kind].append(episode)
    table = Table("fault", "n", "reported", "after s", "by", "longest gap s")
    for kind, episodes in rows.items():
        delays = [e.reported_s - e.begun_s for e in episodes if e.reported_s is not None]
        silent = "nothing" if episodes[0].fault.report else "who starts the programs"
        by = next((e.report for e in episodes if e.report), silent)
        gaps = [
            g.seconds for g in result.gaps for e in episodes if e.begun_s < g.until_s and g.from_s < e.ended_s
        ]
        after = f"{max(delays):.1f}" if delays else ""
        table.add_row(
            kind, str(len(episodes)), str(len(delays)), after, by[:90], f"{max(gaps, default=0.0):.2f}"
        )
    console().print(table)
    for name, growth in sorted(result.growths.items()):
        say(f"memory of {name}: {growth}")
    longest = max((gap.seconds for gap in result.gaps), default=0.0)
    say(f"{len(result.episodes)} faults, {result.poses} tracked poses, RMS {result.rms_m * 1e3:.2f} mm")
    gaps = f"{len(result.gaps)} gaps above {SHORT_S} s, the longest {longest:.2f} s"
    say(f"{gaps}, unexplained {len(result.unexplained())}")
    failures = result.failures()
    for failure in failures[:60]:
        say(f"FAILED {failure}")
    say(f"{len(failures)} failures" if failures else "all holds")


if __name__ == "__main__":
    raise SystemExit(tyro.cli(main))
