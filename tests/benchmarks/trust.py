# SPDX-License-Identifier: BSD-3-Clause
"""Are poses that are called tracked right within their claim, whatever happens to the cameras?
`python -m tests.benchmarks.trust [--only KIND] [--seeds N] [--cameras 3 4] [--quick]`; `--sample N` makes N runs
that are drawn from all kinds, sizes of the ring, numbers and speeds of robots; `--live` makes one of each kind between
processes, in real time (14 s each). Three hours in which nothing happens are
`--only none --seeds 3 --seconds 900`.

Each run is an arena in virtual time (`VirtualArena`): the server's own steps, rings of cameras, moving robots, and one
fault. Judgements of the cameras take as long as on a shared machine. A pose is judged by its squared position error
over its claimed covariance, by 3: 1 on average if the claim is right. Windows are 2 s long and begin with the fault.
The table has one row for each kind of fault and size of the ring.
"""

import os
import re
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path

import msgspec
import numpy as np
import tyro
from rich.table import Table

from calib.rig.rig import Rig
from camera_node.foundation.terminal import console, say, track
from camera_node.geometry.pose import Pose, rotation_from_vector, vector_from_rotation
from fusion.errors import FusionError
from fusion.model.robots import Robot, require_trackable
from fusion.model.states import POSITION
from fusion.protocol.pose_messages import RobotPose
from tests.benchmarks.faults.arena import LiveArena
from tests.benchmarks.faults.judge import PoseJudge
from tests.benchmarks.faults.virtual_arena import VirtualArena
from tests.benchmarks.faults.world import CameraFault
from tests.benchmarks.fusion_load import Load

SETTLE_S, WATCHED_S, WINDOW_S = 3.0, 10.0, 2.0
STEP_S = 0.25  # between two looks at lines and at the rig in use, and between two steps of a slow drift
RIGHT, LARGE = (
    2.0,
    10.0,
)  # mean squared error over claim of a window: allowed, and only for 2 s after the fault
MIN_POSES = 30  # of a window
JUDGING_S = 0.2  # of a judgement: 0.05 to 0.12 s of a core for 4 and 8 cameras, which other programs share
WRONG_PX = 0.2  # twice the noise of a detection
ARENA_M = np.array([[x, y, z] for x in (-1.5, 0, 1.5) for y in (-1.0, 0, 1.0) for z in (0.1, 0.8)])
UNDECIDED = "contradict each other"  # of the server's report that names no camera at fault
REPORTS = (
    "was moved",
    "recalibrated",
    "known pose",
    "stamps",
    "its clock",
    "its markers",
    "its discs",
    "contradicts the other",
    "the rig is",
    "exchanged names",
    UNDECIDED,
)


@dataclass(frozen=True)
class Setting:
    """What the server's files hold, and the faults of the cameras.

    Attributes:
        rig, robots: in the files.
        faults: by name, a number of seconds after they begin.
        guilty: the cameras and robots that may be blamed.
        drifts: whether the faults change with time.
        in_files: whether the fault is in the files, so there from the start.
    """

    rig: Rig
    robots: dict[str, Robot]
    faults: Callable[[float], dict[str, CameraFault]] = lambda elapsed_s: {}
    guilty: frozenset[str] = frozenset()
    drifts: bool = False
    in_files: bool = False


Kind = Callable[[Load, np.random.Generator], Setting]


def unit(rng: np.random.Generator) -> np.ndarray:
    """(3,) a random direction."""
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def setting(load: Load, faults: dict[str, CameraFault]) -> Setting:
    """The true rig, and cameras with faults from a time on."""
    return Setting(Rig(cameras=load.rig), load.bodies, lambda _: faults, frozenset(faults))


def turned(degrees: float) -> Kind:
    def make(load: Load, rng: np.random.Generator) -> Setting:
        name = str(rng.choice(list(load.rig)))
        turn = tuple((np.radians(degrees) * unit(rng)).tolist())
        return setting(load, {name: CameraFault(turn_rad=turn)})

    return make


def shifted(mm: float) -> Kind:
    def make(load: Load, rng: np.random.Generator) -> Setting:
        name = str(rng.choice(list(load.rig)))
        return setting(load, {name: CameraFault(shift_m=tuple((1e-3 * mm * unit(rng)).tolist()))})

    return make


def drifting(degrees: float, over_s: float) -> Kind:
    def make(load: Load, rng: np.random.Generator) -> Setting:
        name, axis = str(rng.choice(list(load.rig))), unit(rng)

        def faults(elapsed_s: float) -> dict[str, CameraFault]:
            turn = np.radians(degrees) * min(elapsed_s / over_s, 1.0) * axis
            return {name: CameraFault(turn_rad=tuple(turn.tolist()))}

        return Setting(Rig(cameras=load.rig), load.bodies, faults, frozenset({name}), drifts=True)

    return make


def on_one_bar(degrees: float) -> Kind:
    """Two neighbours turn together about the point between them."""

    def make(load: Load, rng: np.random.Generator) -> Setting:
        first, names, turn = int(rng.integers(load.cameras)), list(load.rig), np.eye(4)
        pair = [names[first], names[(first + 1) % load.cameras]]
        middle = np.mean([load.rig[name].matrix()[:3, 3] for name in pair], axis=0)
        turn[:3, :3] = rotation_from_vector(np.radians(degrees) * unit(rng))
        turn[:3, 3] = middle - turn[:3, :3] @ middle
        faults = {}
        for name in pair:
            T = load.rig[name].matrix()
            own = np.linalg.inv(T) @ turn @ T
            vector = vector_from_rotation(own[None, :3, :3])[0]
            faults[name] = CameraFault(turn_rad=tuple(vector.tolist()), shift_m=tuple(own[:3, 3].tolist()))
        return setting(load, faults)

    return make


def focal(percent: float, all_cameras: bool = False) -> Kind:
    def make(load: Load, rng: np.random.Generator) -> Setting:
        names = list(load.rig) if all_cameras else [str(rng.choice(list(load.rig)))]
        return setting(load, {name: CameraFault(focal_scale=1 + percent / 100) for name in names})

    return make


def clocks(ms: float, share: float) -> Kind:
    """The clocks of a share of the cameras, at least one, step together."""

    def make(load: Load, rng: np.random.Generator) -> Setting:
        names = rng.choice(list(load.rig), max(1, round(share * load.cameras)), replace=False)
        return setting(load, {str(name): CameraFault(step_ms=ms) for name in names})

    return make


def drifting_clock(ppm: float) -> Kind:
    def make(load: Load, rng: np.random.Generator) -> Setting:
        return setting(load, {str(rng.choice(list(load.rig))): CameraFault(drift_ppm=ppm)})

    return make


def wand(percent: float) -> Kind:
    """The arena's calibration is by a wand that is this much shorter than stated: the rig is larger than the truth."""

    def make(load: Load, rng: np.random.Generator) -> Setting:
        cameras = {}
        for name, camera in load.rig.items():
            T = camera.matrix()
            T[:3, 3] *= 1 + percent / 100
            cameras[name] = msgspec.structs.replace(camera, T_world_cam=Pose.from_matrix(T))
        return Setting(Rig(cameras=cameras), load.bodies, guilty=frozenset({"rig"}), in_files=True)

    return make


def marker(mm: float) -> Kind:
    """A marker of one robot is not where `robots.yaml` has it."""

    def make(load: Load, rng: np.random.Generator) -> Setting:
        name = str(rng.choice(list(load.bodies)))
        first, *others = load.bodies[name].markers
        while True:
            angle = rng.uniform(0, 2 * np.pi)
            x, y = first[:2] + 1e-3 * mm * np.array([np.cos(angle), np.sin(angle)])
            robot = msgspec.structs.replace(
                load.bodies[name], markers=((float(x), float(y), first[2]), *others)
            )
            robots = {**load.bodies, name: robot}
            if is_trackable(robots):
                return Setting(Rig(cameras=load.rig), robots, guilty=frozenset({name}), in_files=True)

    return make


def is_trackable(robots: dict[str, Robot]) -> bool:
    """Whether a server takes them: a robot may be symmetric, or look like another one, once a marker is elsewhere."""
    try:
        require_trackable(robots, "")
    except FusionError:
        return False
    return True


def markers(sigma_mm: float) -> Kind:
    """All markers of all robots are off the places that `robots.yaml` states, as if measured by hand."""

    def make(load: Load, rng: np.random.Generator) -> Setting:
        while True:
            robots = {}
            for name, robot in load.bodies.items():
                off = 1e-3 * sigma_mm * rng.standard_normal((len(robot.markers), 3)) * (1.0, 1.0, 0.0)
                moved = tuple(tuple((place + o).tolist()) for place, o in zip(robot.points, off, strict=True))
                robots[name] = msgspec.structs.replace(robot, markers=moved)
            if is_trackable(robots):
                return Setting(Rig(cameras=load.rig), robots, guilty=frozenset(robots), in_files=True)

    return make


def exchanged(load: Load, rng: np.random.Generator) -> Setting:
    """Two cameras have each other's names."""
    a, b = (str(name) for name in rng.choice(list(load.rig), 2, replace=False))
    cameras = {**load.rig, a: load.rig[b], b: load.rig[a]}
    return Setting(Rig(cameras=cameras), load.bodies, guilty=frozenset({a, b}), in_files=True)


def nothing(load: Load, rng: np.random.Generator) -> Setting:
    return setting(load, {})


KINDS: dict[str, Kind] = {
    "none": nothing,
    **{f"turned {degrees:g} deg": turned(degrees) for degrees in (0.1, 0.3, 0.5, 1.0, 3.0)},
    **{f"shifted {mm:g} mm": shifted(mm) for mm in (5.0, 20.0)},
    "drifting 0.3 deg in 10 s": drifting(0.3, 10.0),
    "bar 0.5 deg": on_one_bar(0.5),
    "focal +0.2 %": focal(0.2),
    "focal +0.7 %": focal(0.7),
    "focal of all +0.5 %": focal(0.5, all_cameras=True),
    **{f"clock +{ms:g} ms": clocks(ms, 0.0) for ms in (10.0, 25.0, 40.0, 1000.0)},
    **{f"clock {ppm:g} ppm": drifting_clock(ppm) for ppm in (50.0, 2000.0)},
    "clocks of 1/2 +40 ms": clocks(40.0, 0.5),
    "clocks of 3/4 +40 ms": clocks(40.0, 0.75),
    "wand 1 % short": wand(1.0),
    **{f"marker {mm:g} mm off": marker(mm) for mm in (5.0, 10.0, 20.0)},
    **{f"all markers {mm:g} mm off": markers(mm) for mm in (0.3, 1.0)},
    "names exchanged": exchanged,
}
FROM_THE_START = ("turned", "shifted", "bar", "focal")  # kinds that are also tried so


class Case(msgspec.Struct, frozen=True, kw_only=True):
    """One run.

    Attributes:
        at_start: the fault was there before the server started.
        live: between processes, in real time.
        seconds: how long it is watched after the fault.
    """

    kind: str
    cameras: int
    seed: int
    at_start: bool = False
    robots: int = 4
    speed_m_s: float = 0.5
    live: bool = False
    seconds: float = WATCHED_S

    @property
    def row(self) -> str:
        return self.kind + (" from the start" if self.at_start else "")


class Outcome(msgspec.Struct, kw_only=True):
    """What a run showed after the fault.

    Attributes:
        report: "right", "undecided", "nothing", or "wrong".
        ratios: mean squared error over claim of the windows, in order; NaN for those with few tracked poses.
        rms_mm: of all tracked poses.
        tracked: share of the robots' poses that were called tracked.
        rewritten: innocent cameras that the server gave a pose by which they show the arena elsewhere than the true one
            by more than `WRONG_PX`, at any time.
        saved_px: largest RMS by which a pose that the server changed shows the arena elsewhere, at the end.
        lines: what the server reported.
    """

    case: Case
    report: str
    ratios: list[float]
    rms_mm: float
    tracked: float
    rewritten: list[str]
    saved_px: float
    lines: list[str]


@dataclass
class ClaimJudge(PoseJudge):
    """Keeps time (s), error (m) and squared error over claim of each tracked pose."""

    rows: list[tuple[float, float, float]] = field(default_factory=list)
    received: int = 0

    def begin(self) -> None:
        """Forget all poses so far."""
        self.rows.clear()
        self.received = 0

    def receive(self, pose: RobotPose) -> None:
        self.received += 1
        super().receive(pose)

    def _compare(self, pose: RobotPose, now_s: float) -> None:
        truth = self.world.states(pose.t_ns).p[self.world.names.index(pose.robot)]
        error = pose.position - truth
        squared = float(error @ np.linalg.solve(pose.covariance_matrix[POSITION, POSITION], error))
        self.rows.append((pose.t_ns * 1e-9, float(np.linalg.norm(error)), squared / 3))


def run(case: Case) -> Outcome:
    """Run one arena."""
    load = Load(
        robots=case.robots,
        cameras=case.cameras,
        hz=30.0,
        speed_m_s=case.speed_m_s,
        crossing=True,
        seed=1 + case.seed,
    )
    rng = np.random.default_rng([case.seed, *case.kind.encode()])  # whatever runs before
    of = KINDS[case.kind](load, rng)
    with (
        tempfile.TemporaryDirectory(prefix="roundel-trust-") as folder,
        _arena(case, load, of, Path(folder)) as arena,
    ):
        if not (case.at_start or of.in_files):
            arena.wait(SETTLE_S)
            arena.new_lines()
        judge, begun_s = arena.judge, arena.clock.now_ns() * 1e-9
        assert isinstance(judge, ClaimJudge)
        judge.begin()
        place(arena, of.faults(0.0))
        lines, rewritten = list[str](), set[str]()
        for elapsed_s in np.arange(STEP_S, case.seconds + STEP_S / 2, STEP_S).tolist():
            arena.wait(STEP_S)
            if of.drifts:
                place(arena, of.faults(elapsed_s))
            lines += [line for _, line in arena.new_lines()]
            rewritten |= {n for n in changed(arena, of.rig) - of.guilty if error_px(arena, n) > WRONG_PX}
        lines = [line for line in lines if any(text in line for text in REPORTS)]
        return Outcome(
            case=case,
            report=judged(lines, of.guilty),
            ratios=windows(judge, begun_s, case.seconds),
            rms_mm=1e3 * float(np.sqrt(np.mean([e**2 for _, e, _ in judge.rows]))) if judge.rows else np.nan,
            tracked=len(judge.rows) / max(judge.received, 1),
            rewritten=sorted(rewritten),
            saved_px=max([error_px(arena, name) for name in changed(arena, of.rig)], default=0.0),
            lines=lines,
        )


@contextmanager
def _arena(case: Case, load: Load, of: Setting, folder: Path) -> Iterator[VirtualArena | LiveArena]:
    """The arena of a case, once it runs."""
    files = {"rig": of.rig, "robots": of.robots, "judge": ClaimJudge}
    if case.live:
        with LiveArena(folder, load, **files) as arena:
            arena.wait_until_running()
            yield arena
    else:
        with VirtualArena(folder, load, case.seed, **files, judging_s=JUDGING_S) as arena:
            yield arena


def place(arena: VirtualArena | LiveArena, faults: dict[str, CameraFault]) -> None:
    """Give the cameras their faults."""
    for name, fault in faults.items():
        arena.place(name, msgspec.structs.replace(fault, since_ns=arena.clock.now_ns()))


def changed(arena: VirtualArena | LiveArena, given: Rig) -> set[str]:
    """The cameras of the rig in use with another pose than the given one."""
    used = arena.used_cameras()
    return {name for name, camera in used.items() if camera.T_world_cam != given[name].T_world_cam}


def error_px(arena: VirtualArena | LiveArena, name: str) -> float:
    """RMS distance between the images of the arena by the pose in use and by the true one."""
    used, true = arena.used_cameras()[name], arena.true_camera(name)
    off = used.project_world(ARENA_M) - true.project_world(ARENA_M)
    return float(np.sqrt(np.nanmean(np.sum(off**2, axis=1))))


def judged(lines: Sequence[str], guilty: Collection[str]) -> str:
    """Who was reported: only cameras at fault, none, several that contradict each other, or an innocent one."""
    definite = [line for line in lines if UNDECIDED not in line]
    named = [re.search(r"(?:the rig is refined.*: )?(?:cameras?|robot|the) (\w+)", line) for line in definite]
    subjects = {found[1] for found in named if found}
    if subjects - set(guilty):
        return "wrong"
    return "right" if subjects else "undecided" if lines else "nothing"


def windows(judge: ClaimJudge, begun_s: float, seconds: float) -> list[float]:
    """Mean squared error over claim in windows since the fault."""
    rows = np.array(judge.rows).reshape(-1, 3)
    index = np.floor((rows[:, 0] - begun_s) / WINDOW_S).astype(int)
    found = []
    for k in range(round(seconds / WINDOW_S)):
        mine = rows[index == k, 2]
        found.append(float(mine.mean()) if len(mine) >= MIN_POSES else float("nan"))
    return found


def cases(only: str, seeds: int, cameras: Sequence[int], quick: bool, seconds: float) -> list[Case]:
    """All runs, those of a kind together."""
    found = []
    for kind in KINDS:
        starts = (False, True) if kind.startswith(FROM_THE_START) and not quick else (False,)
        for n in cameras:
            for at_start in starts:
                found += [
                    Case(kind=kind, cameras=n, seed=s, at_start=at_start, seconds=seconds)
                    for s in range(seeds)
                ]
    return [case for case in found if only in case.row]


def drawn(n: int) -> list[Case]:
    """The first n runs of a series in which the kinds take turns and the rest is drawn, the same for any n."""
    rng, kinds = np.random.default_rng(0), list(KINDS)
    found = []
    for k in range(n):
        kind, seed = kinds[k % len(kinds)], k // len(kinds)
        cameras, robots = int(rng.choice([3, 4, 6, 8])), int(rng.choice([1, 4, 8]))
        speed_m_s, at_start = float(rng.choice([0.0, 0.1, 0.5, 1.0])), bool(rng.random() < 0.5)
        at_start = at_start and kind.startswith(FROM_THE_START)
        found.append(
            Case(kind=kind, cameras=cameras, seed=seed, at_start=at_start, robots=robots, speed_m_s=speed_m_s)
        )
    return found


def outcomes(wanted: Sequence[Case], jobs: int) -> Iterator[Outcome]:
    """Run in several processes, each with one thread; yields outcomes as they come."""
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    if jobs == 1:
        yield from map(run, wanted)
        return
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for future in as_completed([pool.submit(run, case) for case in wanted]):
            yield future.result()


def _read(line: bytes) -> Outcome:
    """An outcome of a file, where NaN is null."""
    content = msgspec.json.decode(line)
    content["ratios"] = [np.nan if ratio is None else ratio for ratio in content["ratios"]]
    content["rms_mm"] = np.nan if content["rms_mm"] is None else content["rms_mm"]
    return msgspec.convert(content, Outcome)


def report(found: Sequence[Outcome], details: bool) -> int:
    """Print a row for each kind and ring; returns how many runs rewrote an innocent camera."""
    table = Table(
        "fault",
        "cameras",
        "runs",
        "right",
        "undecided",
        "nothing",
        "wrong",
        "innocents\nrewritten",
        "windows\nbelow 2",
        "runs above 10\nafter 2 s",
        "worst\nwindow",
        "RMS mm",
        "worst\nrun mm",
        "tracked",
        "changed pose\noff px",
    )
    order = {case: k for k, case in enumerate(KINDS)}

    def key(o: Outcome) -> tuple[int, bool, int]:
        return order[o.case.kind], o.case.at_start, o.case.cameras

    for _, group in groupby(sorted(found, key=key), key):
        table.add_row(*row(list(group)))
    console().print(table)
    for o in found if details else ():
        case = o.case
        of = f"{case.cameras} cameras, {case.robots} robots, {case.speed_m_s:g} m/s, seed {case.seed}"
        say(f"{case.row}, {of}: {o.report}, {o.rms_mm:.2f} mm")
        for line in o.lines:
            say(f"    {line}")
    return sum(bool(o.rewritten) for o in found)


def row(several: list[Outcome]) -> list[str]:
    """The figures of one kind and ring."""
    of, n = several[0].case, len(several)
    ratios = np.array([r for o in several for r in o.ratios])
    late = [o for o in several if any(r > LARGE for r in o.ratios[1:])]
    reports = [o.report for o in several]
    rms = np.array([o.rms_mm for o in several if o.rms_mm > 0])  # of those with poses
    return [
        of.row,
        str(of.cameras),
        str(n),
        *(str(reports.count(kind)) for kind in ("right", "undecided", "nothing", "wrong")),
        str(sum(bool(o.rewritten) for o in several)),
        f"{np.mean(ratios[np.isfinite(ratios)] < RIGHT):.0%}" if np.isfinite(ratios).any() else "-",
        str(len(late)),
        f"{np.nanmax(ratios, initial=0):.1f}",
        f"{np.sqrt(np.mean(rms**2)):.2f}" if len(rms) else "-",
        f"{np.max(rms):.2f}" if len(rms) else "-",
        f"{np.mean([o.tracked for o in several]):.0%}",
        f"{max(o.saved_px for o in several):.2f}",
    ]


def main(
    only: str = "",
    seeds: int = 3,
    cameras: tuple[int, ...] = (3, 4, 6, 8),
    quick: bool = False,
    seconds: float = WATCHED_S,
    sample: int = 0,
    live: bool = False,
    details: bool = False,
    jobs: int = 2,
    save: Path | None = None,
) -> int:
    """Print the table; exit code 1 if a run rewrote an innocent camera.

    Args:
        only: rows whose names contain this.
        seeds: runs of each row.
        cameras: sizes of the ring.
        quick: no faults that were there before the server started.
        seconds: for which each run of a table is watched after the fault.
        sample: runs that are drawn, in place of those of a table.
        live: one run of each kind between processes, one after the other, in place of those of a table.
        details: print what the server reported in each run.
        jobs: processes.
        save: a file for the outcomes as JSON lines; those that it holds are not run again.
    """
    wanted = drawn(sample) if sample else cases(only, seeds, cameras, quick, seconds)
    if live:
        wanted, jobs = [Case(kind=kind, cameras=4, seed=0, live=True) for kind in KINDS if only in kind], 1
    saved = save.read_bytes().splitlines() if save is not None and save.exists() else []
    found = [o for o in map(_read, saved) if o.case in wanted]
    wanted = [case for case in wanted if case not in {outcome.case for outcome in found}]
    for outcome in track(outcomes(wanted, jobs), "trust", len(wanted)):
        found.append(outcome)
        if save is not None:
            with save.open("ab") as file:
                file.write(msgspec.json.encode(outcome) + b"\n")
    rewritten = report(found, details)
    say(f"{rewritten} of {len(found)} runs rewrote an innocent camera")
    return int(rewritten > 0)


if __name__ == "__main__":
    raise SystemExit(tyro.cli(main))
