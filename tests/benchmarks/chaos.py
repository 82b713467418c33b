# SPDX-License-Identifier: BSD-3-Clause
"""Random faults every few seconds: `python -m tests.benchmarks.chaos [--minutes 30] [--seed 1] [--virtual]`.

Server, four cameras at 30 Hz, viewer, page, recorder, client and a node that renders its images run as processes and
follow ten robots. Nothing may crash, every fault is reported, and poses are right and without unexplained gaps.
If something does not hold, the folder with the logs stays.
"""

import random
import shutil
import tempfile
import threading
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import tyro

from camera_node.foundation.terminal import say, track
from tests.benchmarks.faults.arena import LiveArena, small_load
from tests.benchmarks.faults.chaos_result import SETTLE_S, ChaosResult, Episode, report, save_events
from tests.benchmarks.faults.judge import Gap
from tests.benchmarks.faults.kinds import KINDS, VIRTUAL
from tests.benchmarks.faults.programs import END_S, Programs
from tests.benchmarks.faults.reports import Evidence
from tests.benchmarks.faults.virtual_arena import VirtualArena
from tests.benchmarks.fuzz import EXTRA

PAUSE_S = 0.5, 3.0  # between two faults
STEP_S = 0.05  # between two looks at logs and status
WAITS_S = 0.2  # between two looks at how long threads waited for a processor
MAX_WAITS = 400  # looks: longer than a fault takes to end


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
        while fault.report and episode.reported_s is None and clock.now_s() < episode.ended_s + SETTLE_S:
            self._look((episode, evidence), STEP_S)

    def _look(self, current: tuple[Episode, Evidence] | None, seconds: float) -> None:
        """Follow logs and status for a time."""
        arena, now_s = self.arena, self.arena.clock.now_s
        end_s, next_s = now_s() + seconds, 0.0
        while now_s() < end_s:
            arena.wait(STEP_S)
            lines = [f"{program}: {line}" for program, line in arena.new_lines()]
            if current and current[0].fault.report and current[0].reported_s is None:
                episode, evidence = current
                evidence.lines += lines
                if report := current[0].fault.report(evidence):
                    episode.reported_s, episode.report = now_s(), report
            arena.inspect(samples_memory=now_s() > next_s)
            if now_s() > next_s:
                next_s = now_s() + 1.0
            self._note_gaps()

    def sample_waits(self, programs: Programs, ended: threading.Event) -> None:
        """Note how long threads waited for a processor until the event, also while a fault begins or ends."""
        while not ended.wait(WAITS_S):
            self._waits = [*self._waits[-MAX_WAITS:], (self.arena.clock.now_s(), programs.waited_s())]

    def _note_gaps(self) -> None:
        """Compute the waits of new gaps while the samples are recent."""
        gaps, self.arena.judge.gaps[:] = self.arena.judge.gaps[:], []
        for gap in gaps:
            self.result.gaps.append(gap)
            self.result.waits_s[gap] = self._waited_s(gap)

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
        run, ended = Chaos(arena, random.Random(seed), kinds), threading.Event()
        sampler = threading.Thread(target=run.sample_waits, args=(arena.programs, ended), daemon=True)
        sampler.start()
        try:
            yield from run.run(seconds)
        finally:
            ended.set()
            sampler.join(END_S)
    run.result.crashes = arena.programs.crashes
    run.result.growths = arena.programs.growths()
    arena.programs.save_memory(folder / "memory.txt")
    yield run.result


def virtual_chaos(
    folder: Path, seconds: float, seed: int, kinds: Sequence[str] = VIRTUAL, judging_s: float = 0.0
) -> Iterator[float | ChaosResult]:
    """The same in virtual time; the kinds are faults of cameras and robots."""
    with VirtualArena(folder, small_load(), seed, judging_s=judging_s) as arena:
        arena.wait(2 * SETTLE_S)
        arena.judge.forget()
        arena.new_lines()
        run = Chaos(arena, random.Random(seed), kinds)
        yield from run.run(seconds)
    yield run.result


def main(
    minutes: float = 30.0,
    seed: int = 1,
    kinds: tuple[str, ...] = tuple(KINDS),
    virtual: bool = False,
    judging_s: float = 0.4,
) -> int:
    """Print what each kind of fault caused and who reported it; exit code 1 if something does not hold.

    Args:
        minutes: how long.
        seed: of the choices.
        kinds: of faults.
        virtual: in virtual time, without network and processes; of the kinds those of cameras and robots.
        judging_s: how long a judgement of the cameras takes in virtual time: 0.4 s of a process with few processors.
    """
    result = ChaosResult()
    if virtual:
        kinds = tuple(kind for kind in kinds if kind in VIRTUAL)
    folder = Path(tempfile.mkdtemp(prefix="roundel-chaos-"))
    run = partial(virtual_chaos, judging_s=judging_s) if virtual else chaos
    for step in track(run(folder, 60 * minutes, seed, kinds), "chaos"):
        if isinstance(step, ChaosResult):
            result = step
    report(result)
    if result.failures():
        save_events(result, folder / "events.txt")
        say(f"logs of the programs, and the events of the run: {folder}")
        return 1
    shutil.rmtree(folder)
    return 0


if __name__ == "__main__":
    raise SystemExit(tyro.cli(main))
