# SPDX-License-Identifier: BSD-3-Clause
"""The results of an offline run: `poses.csv`, and a summary in words."""

import csv
import io
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from camera_node.foundation.config import write_atomically
from fusion.monitoring.extrinsics_monitor import ExtrinsicsCorrection
from fusion.protocol.pose_messages import RobotPose
from fusion.tracking.result import TOO_MANY_UNASSIGNED, TrackingResult

COLUMNS = "t_ns,robot,x,y,z,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz,state,n_markers,n_cameras"
STATES = ("tracked", "coasting", "lost")


@dataclass
class Summary:
    """Counts over a run."""

    frame_sets: int = 0
    states: Counter[tuple[str, str]] = field(default_factory=Counter)
    used: Counter[str] = field(default_factory=Counter)
    unused: Counter[str] = field(default_factory=Counter)
    squared_px: dict[str, float] = field(default_factory=dict)
    unlabeled: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    moves: list[str] = field(default_factory=list)

    def add(self, fused: TrackingResult) -> None:
        """Count a fused frame set."""
        self.frame_sets += 1
        self.states.update((pose.robot, pose.state) for pose in fused.poses)
        self.unlabeled += int((fused.markers.robot_index() < 0).sum())
        self.faults.update(f"{TOO_MANY_UNASSIGNED}, of camera '{name}'" for name in fused.crowded)
        for name, use in fused.cameras.items():
            self.used[name] += use.used
            self.unused[name] += use.unused
            self.squared_px[name] = self.squared_px.get(name, 0.0) + use.squared_px

    def add_correction(self, correction: ExtrinsicsCorrection, t_ns: int) -> None:
        """Note that a camera was moved, or recalibrated after a move."""
        if correction.camera is None:
            event = f"seen at t_ns {t_ns}; its detections are excluded from then on"
        else:
            event = f"recalibrated at t_ns {t_ns} and used again; the rig file is unchanged"
        self.moves.append(f"moved: camera '{correction.name}', {event}")

    def lines(self, robots: Iterable[str]) -> Iterator[str]:
        """The summary, one line a subject."""
        yield f"{self.frame_sets} frame sets, {self.unlabeled} unlabeled markers"
        for robot in robots:
            shares = (f"{s} {self.states[robot, s] / max(self.frame_sets, 1):.1%}" for s in STATES)
            yield f"{robot}: {', '.join(shares)}"
        for name in sorted(self.used):
            rms = np.sqrt(self.squared_px[name] / self.used[name]) if self.used[name] else np.nan
            yield (
                f"{name}: residual {rms:.2f} px, {self.used[name]} detections assigned, {self.unused[name]} not"
            )
        for reason, count in sorted(self.faults.items()):
            yield f"skipped: {count} {reason}"
        yield from self.moves


def write_poses(path: Path, fused: Iterable[TrackingResult]) -> None:
    """Write all poses of fused frame sets, as `write_pose_table`."""
    write_pose_table(path, (pose for frame_set in fused for pose in frame_set.poses))


def write_pose_table(path: Path, poses: Iterable[RobotPose]) -> None:
    """Write poses as CSV with `COLUMNS`, atomically.

    Raises:
        ConfigError: the folder can't be written to.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS.split(","))
    writer.writerows(map(_row, poses))
    write_atomically(path, text.getvalue())


def _row(pose: RobotPose) -> list:
    numbers = (*pose.position, *pose.quaternion_wxyz, *pose.velocity, *pose.angular_velocity)
    digits = [f"{number:.7g}" for number in numbers]
    return [pose.t_ns, pose.robot, *digits, pose.state, pose.n_markers, len(pose.cameras)]
