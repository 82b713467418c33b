# SPDX-License-Identifier: BSD-3-Clause
"""How far the arena's poses are from the simulation's truth, and whether that is good enough."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from camera_node.arrays import Array
from camera_node.geometry.pose import rotation_from_wxyz
from fusion.protocol.messages import RobotPose

RMS_MM, GAP_S = (
    5.0,
    0.5,
)  # what a demo must reach: position error, and the longest time that a robot is not tracked


@dataclass(frozen=True)
class Result:
    """One robot over the time that was scored. What nothing is known of is NaN."""

    robot: str
    tracked: float  # share of its poses in the state "tracked", 0 to 1
    rms_mm: float
    max_mm: float
    rotation_deg: float  # RMS; NaN for a robot of one marker, whose turn about its normal is not known
    gap_s: float  # the longest time without a tracked pose

    def faults(self) -> list[str]:
        """What is wrong with it, in words; nothing where all is well."""
        if np.isnan(self.rms_mm):
            return [f"{self.robot} was never tracked"]
        found = []
        if self.rms_mm > RMS_MM:
            found.append(f"{self.robot} is {self.rms_mm:.1f} mm RMS from the truth (limit {RMS_MM:.0f} mm)")
        if self.gap_s > GAP_S:
            found.append(f"{self.robot} was lost for {self.gap_s:.2f} s (limit {GAP_S} s)")
        return found


@dataclass
class ScoredTrack:
    """What became of one robot's poses."""

    poses: int = 0
    t_ns: list[int] = field(default_factory=list)  # of the tracked ones, as are the errors
    position_mm: list[float] = field(default_factory=list)
    rotation_deg: list[float] = field(default_factory=list)


class Score:
    """Compares poses with the truth as they come.

    `truth(robot, t_ns)` is T_world_robot (4, 4), None while the robot is not there.
    """

    def __init__(
        self, truth: Callable[[str, int], Array | None], robots: dict[str, int], start_ns: int = 0
    ) -> None:
        """`robots` maps a name to its number of markers; poses of before `start_ns` do not count."""
        self._truth, self._markers, self._start_ns = truth, robots, start_ns
        self.tracks = {robot: ScoredTrack() for robot in robots}
        self.latencies_ms: list[float] = []

    def add(self, pose: RobotPose) -> None:
        """Take one pose into account; robots that the truth does not know count for nothing."""
        counts = pose.robot in self.tracks and pose.t_ns >= self._start_ns
        T_true = self._truth(pose.robot, pose.t_ns) if counts else None
        if T_true is None:
            return
        track = self.tracks[pose.robot]
        track.poses += 1
        if pose.latency is not None:
            self.latencies_ms.append(pose.latency.total_ms)
        if pose.state != "tracked":
            return
        position, R = np.array(pose.position), rotation_from_wxyz(pose.quaternion_wxyz)
        track.t_ns.append(pose.t_ns)
        track.position_mm.append(1e3 * float(np.linalg.norm(position - T_true[:3, 3])))
        track.rotation_deg.append(angle_deg(R, T_true[:3, :3]))

    def all_tracked(self) -> bool:
        """Whether every robot has been tracked at least once."""
        return all(track.t_ns for track in self.tracks.values())

    def recent_mm(self, robot: str, count: int = 30) -> float:
        """RMS error of the robot's newest tracked poses, millimetres; NaN where there are none."""
        return rms(self.tracks[robot].position_mm[-count:])

    def results(self, start_ns: int, end_ns: int) -> list[Result]:
        """One result a robot for the time from `start_ns` to `end_ns`."""
        return [self._result(robot, track, start_ns, end_ns) for robot, track in self.tracks.items()]

    def _result(self, robot: str, track: ScoredTrack, start_ns: int, end_ns: int) -> Result:
        count = len(track.t_ns)
        constellation = self._markers[robot] > 1
        return Result(
            robot=robot,
            tracked=count / track.poses if track.poses else 0.0,
            rms_mm=rms(track.position_mm[:count]),
            max_mm=max(track.position_mm[:count], default=float("nan")),
            rotation_deg=rms(track.rotation_deg[:count]) if constellation else float("nan"),
            gap_s=longest_gap_s(track.t_ns[:count], start_ns, end_ns),
        )


def longest_gap_s(t_ns: list[int], start_ns: int, end_ns: int) -> float:
    """The longest time from `start_ns` to `end_ns` that holds none of the times, seconds."""
    inside = [t for t in sorted(t_ns) if start_ns < t < end_ns]
    return float(np.diff([start_ns, *inside, end_ns]).max()) * 1e-9


def angle_deg(A: Array, B: Array) -> float:
    """The angle between two rotations (3, 3), degrees."""
    half_chord = np.linalg.norm(A - B) / np.sqrt(8.0)  # |A - B|_F = 2 sqrt(2) sin(angle / 2)
    return float(np.degrees(2 * np.arcsin(min(1.0, half_chord))))


def rms(values: list[float]) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if values else float("nan")


def summarise(results: list[Result], latencies_ms: list[float]) -> list[str]:
    """The lines of a summary."""
    lines = [_describe(result) for result in results]
    if latencies_ms:
        p50, p99 = np.percentile(latencies_ms, [50, 99])
        lines.append(f"latency: {p50:.1f} ms p50, {p99:.1f} ms p99 (newest exposure's middle to publication)")
    return lines


def _describe(result: Result) -> str:
    if np.isnan(result.rms_mm):
        return f"{result.robot}: never tracked"
    turn = "" if np.isnan(result.rotation_deg) else f"rotation {result.rotation_deg:.2f} degrees RMS; "
    return (
        f"{result.robot}: position {result.rms_mm:.2f} mm RMS, {result.max_mm:.2f} mm max; {turn}"
        f"tracked {100 * result.tracked:.1f} %; longest gap {result.gap_s:.2f} s"
    )
