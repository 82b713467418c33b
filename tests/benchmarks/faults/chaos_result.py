# SPDX-License-Identifier: BSD-3-Clause
"""What happened in a run of random faults, and what of it does not hold."""

import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from rich.table import Table

from camera_node.foundation.terminal import console, say
from tests.benchmarks.faults.judge import Gap, WrongPose
from tests.benchmarks.faults.kinds import LONGEST_S, SHORT_S, Fault
from tests.benchmarks.faults.memory import Growth

SETTLE_S = 3.0  # after a fault, in which a gap is explained by it and its report counts
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
        """What does not hold, one line each, the worst first: a report has the first lines only."""
        return [
            *(f"crash: {crash}" for crash in self.crashes),
            *self._describe_wrong(),
            *(f"{name} grows by {growth}" for name, growth in self.growths.items() if growth.is_excessive),
            *(f"not reported: {e.kind} of {e.fault.target}" for e in self.unreported()),
            *(self._describe(gap, "long gap") for gap in self.longest()),
            *(self._describe(gap, "unexplained gap") for gap in self.unexplained()),
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


def save_events(result: ChaosResult, path: Path) -> None:
    """Write all faults, gaps and wrong poses, by the clock of the run."""
    events = [
        (e.begun_s, f"{e.kind} of {e.fault.target} until {e.ended_s:.2f}: {e.report}")
        for e in result.episodes
    ]
    events += [(g.from_s, f"gap of {g.robot}, {g.seconds:.2f} s") for g in result.gaps]
    events += [(p.received_s, f"wrong pose of {p.robot}, {1e3 * p.error_m:.0f} mm") for p in result.wrong]
    offset = f"the system clock is {time.time() - time.monotonic():.3f} s ahead of the monotonic clock\n"
    path.write_text(offset + "".join(f"{at_s:.3f} {text}\n" for at_s, text in sorted(events)))
