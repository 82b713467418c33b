# SPDX-License-Identifier: BSD-3-Clause
"""Are robots that leave the cameras' views answered as soon as two cameras see them again?
`python -m tests.benchmarks.coverage [--cameras 3 4 8] [--hz 30 60] [--robots 4] [--seconds 20]`

Robots cross an arena of which each camera sees a part, in virtual time (`VirtualArena`): each leaves all views several
times. Two cameras see a robot if each shows three of its markers, or all that it has, free of noise and of lost
detections. Of the poses that the server publishes for robots that are seen so, the table has how many are tracked; the
same of those that have been seen for 0.3 s; of the entries of lost robots, how many are answered within 0.3 s; and the
poses that are wrong.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
import tyro
from rich.table import Table

from calib.rig.camera import Camera
from camera_node.foundation.arrays import Mask
from camera_node.foundation.terminal import console, track
from fusion.protocol.pose_messages import RobotPose
from tests.benchmarks.faults.judge import PoseJudge
from tests.benchmarks.faults.virtual_arena import VirtualArena
from tests.benchmarks.fusion_load import Load, Scene

NARROWER = 2.0  # focal lengths over those with which all cameras see the floor of the robots
SHOWN = 3  # markers by which a camera shows a robot
SOON_S = 0.3
SETTLE_S = 3.0


class NarrowLoad(Load):
    """Robots that leave the views of the cameras."""

    @cached_property
    def rig(self) -> dict[str, Camera]:
        return {
            name: msgspec.structs.replace(camera, fx=NARROWER * camera.fx, fy=NARROWER * camera.fy)
            for name, camera in super().rig.items()
        }


class Visibility:
    """Which robots two cameras see, by what they detect without noise and without losses."""

    def __init__(self, load: Load) -> None:
        self._scene = Scene(replace(load, missing=0.0, false=0.0, sigma_px=0.0))
        self._robot = self._scene.marker_table.robot
        self._due = np.minimum(SHOWN, np.bincount(self._robot))

    def seen(self, t_s: float) -> Mask:
        """(robots,) whether two cameras or more see each of them at a time of the load."""
        scene, rng = self._scene, np.random.default_rng(0)  # of the order of detections
        states = scene.load.paths.at(t_s)
        count = [
            np.bincount(self._robot[scene.roundels(k, states, rng).track], minlength=len(self._due))
            for k in range(len(scene.cameras.names))
        ]
        return np.asarray((np.array(count) >= self._due).sum(axis=0) >= 2, bool)


@dataclass
class CoverageJudge(PoseJudge):
    """Keeps time (s), robot, and whether it is tracked, of all poses."""

    rows: list[tuple[float, int, bool]] = field(default_factory=list)

    def receive(self, pose: RobotPose) -> None:
        t_s = (pose.t_ns - self.world.epoch_ns) * 1e-9
        self.rows.append((t_s, self.world.names.index(pose.robot), pose.state == "tracked"))
        super().receive(pose)


@dataclass
class Shares:
    """Poses of robots that two cameras see, and entries of lost robots into their views, and how many are answered."""

    poses: int = 0
    tracked: int = 0
    later: int = 0
    tracked_later: int = 0
    entries: int = 0
    soon: int = 0

    def add(self, times: Sequence[float], seen: Sequence[bool], tracked: Sequence[bool]) -> None:
        """The poses of a robot in order of time."""
        entered_s, was_seen, was_tracked = times[0], True, True  # when the first view began is not known
        is_answered = True
        for t_s, is_seen, is_tracked in zip(times, seen, tracked, strict=True):
            if is_seen and not was_seen:
                entered_s, is_answered = t_s, was_tracked
            if is_seen:
                is_late = t_s > entered_s + SOON_S
                self.poses += 1
                self.tracked += is_tracked
                self.later += is_late
                self.tracked_later += is_late and is_tracked
                if not is_answered and (is_tracked or is_late):
                    self.entries, self.soon, is_answered = self.entries + 1, self.soon + is_tracked, True
            was_seen, was_tracked = is_seen, is_tracked

    @property
    def row(self) -> tuple[str, ...]:
        """Of the table."""
        parts = (
            (self.tracked, self.poses),
            (self.tracked_later, self.later),
            (self.soon, self.entries),
        )
        return tuple(f"{100 * part / max(1, whole):.1f} % of {whole}" for part, whole in parts)


def measure(load: Load, seconds: float, seed: int) -> tuple[Shares, CoverageJudge]:
    """Run one arena."""
    shares, visibility = Shares(), Visibility(load)
    with (
        tempfile.TemporaryDirectory(prefix="roundel-coverage-") as folder,
        VirtualArena(Path(folder), load, seed, judge=CoverageJudge) as arena,
    ):
        arena.wait(SETTLE_S)
        judge = arena.judge
        assert isinstance(judge, CoverageJudge)
        judge.rows.clear()
        judge.forget()
        arena.wait(seconds)
    rows = np.array(judge.rows)
    seen_at = {t_s: visibility.seen(t_s) for t_s in np.unique(rows[:, 0]).tolist()}
    for robot in range(load.robots):
        of_robot = rows[rows[:, 1] == robot]
        times = of_robot[:, 0].tolist()
        shares.add(times, [bool(seen_at[t_s][robot]) for t_s in times], of_robot[:, 2].astype(bool).tolist())
    return shares, judge


def main(
    cameras: tuple[int, ...] = (3, 4, 8),
    hz: tuple[float, ...] = (30.0, 60.0),
    robots: int = 4,
    seconds: float = 20.0,
    speed_m_s: float = 1.0,
    seed: int = 1,
) -> int:
    """Print the table; exit code 1 if a goal is missed.

    Args:
        cameras: of each ring.
        hz: rates of the cameras.
        robots: that cross the arena.
        seconds: of each run, in virtual time.
        speed_m_s: of the robots.
        seed: of the paths, the noise and the transit of messages.
    """
    table = Table(
        "cameras", "Hz", "tracked", f"after {SOON_S} s", f"entries answered\nin {SOON_S} s", "wrong", "RMS mm"
    )
    holds = True
    for n, rate in track([(n, rate) for n in cameras for rate in hz], "arenas", len(cameras) * len(hz)):
        load = NarrowLoad(robots=robots, cameras=n, hz=rate, speed_m_s=speed_m_s, crossing=True, seed=seed)
        shares, judge = measure(load, seconds, seed)
        table.add_row(str(n), f"{rate:g}", *shares.row, str(len(judge.wrong)), f"{1e3 * judge.rms_m:.2f}")
        answered = shares.tracked >= 0.8 * shares.poses and shares.tracked_later >= 0.97 * shares.later
        holds = holds and answered and not judge.wrong
    console().print(table)
    return 0 if holds else 1


if __name__ == "__main__":
    raise SystemExit(tyro.cli(main))
