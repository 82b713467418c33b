# SPDX-License-Identifier: BSD-3-Clause
"""Does a rig stay as good as on its first day while all cameras turn and sag?
`python -m tests.benchmarks.rig_drift [--seconds 100] [--degrees-per-hour 1.5] [--mm-per-hour 15] [--cameras 4]`

An arena in virtual time (`VirtualArena`): each camera turns about an axis of its own and sinks. A row for ten seconds
has the errors of tracked robots, in the world frame and after the best motion of all positions (what all cameras have
in common is not seen), those errors over the ones before the drift, squared errors over their claim, and counts of what
the server reported. Errors vary with the places of robots: compare with a run without drift, and with `--no-refine`.
"""

import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from rich.table import Table

from camera_node.foundation.terminal import console, say, track
from fusion.protocol.pose_messages import RobotPose
from tests.benchmarks.faults.virtual_arena import VirtualArena
from tests.benchmarks.faults.world import CameraFault
from tests.benchmarks.fusion_load import Load
from tests.benchmarks.trust import ClaimJudge, place, unit

FRESH_S, STEP_S, ROW_S = 6.0, 0.5, 10.0  # before the drift, between two steps of it, and between two rows


@dataclass
class PositionJudge(ClaimJudge):
    """Keeps the published and the true positions (6,) of each tracked pose as well."""

    positions: list[np.ndarray] = field(default_factory=list)

    def _compare(self, pose: RobotPose, now_s: float) -> None:
        truth = self.world.states(pose.t_ns).p[self.world.names.index(pose.robot)]
        self.positions.append(np.concatenate([pose.position, truth]))
        super()._compare(pose, now_s)


def rms_mm(positions: np.ndarray) -> tuple[float, float]:
    """RMS error of positions (n, 6), and after the rotation and translation that fit best (Kabsch 1976), mm."""
    found, truth = positions[:, :3], positions[:, 3:]
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    of = (found - truth, a @ R - b)
    raw, aligned = (1e3 * float(np.sqrt(np.sum(off**2, axis=1).mean())) for off in of)
    return raw, aligned


def drifted(load: Load, axes: np.ndarray, degrees: float, mm: float) -> dict[str, CameraFault]:
    """The cameras after a turn about their axes (C, 3) and a fall."""
    faults = {}
    for (name, camera), axis in zip(load.rig.items(), axes, strict=True):
        down = camera.matrix()[:3, :3].T @ [0.0, 0.0, -1e-3 * mm]
        turn = np.radians(degrees) * axis
        faults[name] = CameraFault(turn_rad=tuple(turn.tolist()), shift_m=tuple(down.tolist()))
    return faults


def main(
    seconds: float = 100.0,
    degrees_per_hour: float = 1.5,
    mm_per_hour: float = 15.0,
    cameras: int = 4,
    robots: int = 2,
    speed_m_s: float = 0.5,
    refine: bool = True,
    seed: int = 1,
) -> int:
    """Print the table.

    Args:
        seconds: of the drift, in virtual time.
        degrees_per_hour: by which each camera turns.
        mm_per_hour: by which each camera sinks.
        cameras: of the ring.
        robots: that move.
        speed_m_s: of the robots.
        refine: whether the server corrects the rig.
        seed: of the paths, the noise and the axes.
    """
    load = Load(robots=robots, cameras=cameras, hz=30.0, speed_m_s=speed_m_s, crossing=True, seed=seed)
    rng = np.random.default_rng(seed)
    axes = np.array([unit(rng) for _ in load.rig])
    table = Table(
        "s", "RMS mm", "aligned mm", "over fresh", "squared error\nover claim", "refined", "other lines"
    )
    with (
        tempfile.TemporaryDirectory(prefix="roundel-drift-") as folder,
        VirtualArena(Path(folder), load, seed, judge=PositionJudge) as arena,
    ):
        arena.server.pipeline.refine(refine)
        arena.wait(FRESH_S)
        judge = arena.judge
        assert isinstance(judge, PositionJudge)
        fresh_mm = rms_mm(np.array(judge.positions))[1]
        arena.new_lines()
        for begun_s in track(np.arange(0.0, seconds, ROW_S), "drift", round(seconds / ROW_S)):
            judge.begin()
            judge.positions.clear()
            for elapsed_s in np.arange(begun_s + STEP_S, begun_s + ROW_S + STEP_S / 2, STEP_S).tolist():
                hours = elapsed_s / 3600
                place(arena, drifted(load, axes, degrees_per_hour * hours, mm_per_hour * hours))
                arena.wait(STEP_S)
            raw, aligned = rms_mm(np.array(judge.positions))
            lines = [line for _, line in arena.new_lines()]
            n_refined = sum("is refined" in line for line in lines)
            table.add_row(
                f"{begun_s + ROW_S:.0f}",
                f"{raw:.2f}",
                f"{aligned:.2f}",
                f"{aligned / fresh_mm:.2f}",
                f"{np.mean([squared for _, _, squared in judge.rows]):.2f}",
                str(n_refined),
                str(len(lines) - n_refined),
            )
    console().print(table)
    say(f"before the drift: {fresh_mm:.2f} mm")
    return 0


if __name__ == "__main__":
    raise SystemExit(tyro.cli(main))
