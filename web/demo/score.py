# SPDX-License-Identifier: BSD-3-Clause
"""Compares poses with the simulation's true poses, decides whether the demo passed, and measures resources."""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import psutil

from calib.rig.estimation import rms
from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import rotation_angle, rotation_from_wxyz
from fusion.protocol.pose_messages import RobotPose
from web.state.feed import Feed

MAX_RMS_MM = 5.0  # position error of a demo that passes
MAX_GAP_S = 0.5  # longest time without a tracked pose of a demo that passes
MIN_RATE = 0.9  # of a camera's frame rate, below which the machine is too slow for it


@dataclass(frozen=True)
class RobotScore:
    """The errors of one robot's tracked poses. Unknown values are NaN."""

    robot: str
    tracked: float  # share of its poses in the state "tracked", 0 to 1
    rms_mm: float
    max_mm: float
    rotation_deg: float  # RMS; NaN for a robot of one marker, whose heading is unobservable
    gap_s: float  # longest time without a tracked pose
    normalized: float  # mean squared position error over the claimed variance, per coordinate: 1 is due

    def faults(self, not_acquired: str | None = None) -> list[str]:
        """Return the limits that the robot exceeds, as text.

        Args:
            not_acquired: why the server does not track it now, if it does not.
        """
        if np.isnan(self.rms_mm):
            return [f"{self.robot} was never tracked" + (f": {not_acquired}" if not_acquired else "")]
        faults = []
        if self.rms_mm > MAX_RMS_MM:
            faults.append(
                f"{self.robot}: position error {self.rms_mm:.1f} mm RMS (limit {MAX_RMS_MM:.0f} mm)"
            )
        if self.gap_s > MAX_GAP_S:
            faults.append(f"{self.robot}: not tracked for {self.gap_s:.2f} s (limit {MAX_GAP_S} s)")
        return faults


@dataclass
class RobotErrors:
    """The errors of one robot's tracked poses, one entry per pose, and the number of all its poses."""

    n_poses: int = 0
    t_ns: list[int] = field(default_factory=list)
    position_mm: list[float] = field(default_factory=list)
    rotation_deg: list[float] = field(default_factory=list)
    normalized: list[float] = field(default_factory=list)


class PoseScore:
    """Compares poses with true poses as they arrive."""

    def __init__(
        self, true_pose: Callable[[str, int], Array | None], n_markers: dict[str, int], start_ns: int = 0
    ) -> None:
        """Create a score without poses.

        Args:
            true_pose: returns T_world_robot (4, 4) of a robot at a time (ns), None while the robot is not there.
            n_markers: number of markers, by robot; poses of other robots do not count.
            start_ns: earlier poses do not count.
        """
        self._true_pose, self._n_markers, self._start_ns = true_pose, n_markers, start_ns
        self.errors = {robot: RobotErrors() for robot in n_markers}
        self.latencies_ms: list[float] = []

    def add(self, pose: RobotPose) -> None:
        """Compare one pose."""
        counts = pose.robot in self.errors and pose.t_ns >= self._start_ns
        T_true = self._true_pose(pose.robot, pose.t_ns) if counts else None
        if T_true is None:
            return
        errors = self.errors[pose.robot]
        errors.n_poses += 1
        if pose.latency is not None:
            self.latencies_ms.append(pose.latency.total_ms)
        if pose.state != "tracked":
            return
        position, R = np.array(pose.position), rotation_from_wxyz(pose.quaternion_wxyz)
        errors.t_ns.append(pose.t_ns)
        errors.position_mm.append(1e3 * float(np.linalg.norm(position - T_true[:3, 3])))
        errors.rotation_deg.append(float(np.degrees(rotation_angle(R.T @ T_true[:3, :3]))))
        errors.normalized.append(_normalized(position - T_true[:3, 3], pose))

    def all_tracked(self) -> bool:
        """Whether each robot had at least one tracked pose."""
        return all(errors.t_ns for errors in self.errors.values())

    def recent_mm(self, robot: str, count: int = 30) -> float:
        """Return the RMS position error of the robot's latest tracked poses, millimetres; NaN without any."""
        return rms(self.errors[robot].position_mm[-count:])

    def results(self, start_ns: int, end_ns: int) -> list[RobotScore]:
        """Return one result per robot; `start_ns` and `end_ns` bound the gaps."""
        return [self._result(robot, errors, start_ns, end_ns) for robot, errors in self.errors.items()]

    def _result(self, robot: str, errors: RobotErrors, start_ns: int, end_ns: int) -> RobotScore:
        count = len(errors.t_ns)  # poses may arrive in another thread: use the same number of each list
        has_heading = self._n_markers[robot] > 1
        return RobotScore(
            robot=robot,
            tracked=count / errors.n_poses if errors.n_poses else 0.0,
            rms_mm=rms(errors.position_mm[:count]),
            max_mm=max(errors.position_mm[:count], default=float("nan")),
            rotation_deg=rms(errors.rotation_deg[:count]) if has_heading else float("nan"),
            gap_s=longest_gap_s(errors.t_ns[:count], start_ns, end_ns),
            normalized=float(np.mean(errors.normalized[:count])) if count else float("nan"),
        )


def _normalized(error: Array, pose: RobotPose) -> float:
    """The squared error of the position over its claim, per coordinate; both in the world, see `RobotPose`."""
    covariance = pose.covariance_matrix[3:6, 3:6]
    return float(error @ np.linalg.lstsq(covariance, error, rcond=None)[0] / 3)


def longest_gap_s(t_ns: list[int], start_ns: int, end_ns: int) -> float:
    """Return the longest interval between `start_ns` and `end_ns` without any of the times, seconds."""
    inside = [t for t in sorted(t_ns) if start_ns < t < end_ns]
    return float(np.diff([start_ns, *inside, end_ns]).max()) * 1e-9


def summarize(results: list[RobotScore], latencies_ms: list[float]) -> list[str]:
    """Return the lines of the summary: one per robot, and one on the latency if known."""
    lines = [_describe(result) for result in results]
    if latencies_ms:
        p50, p99 = np.percentile(latencies_ms, [50, 99])
        lines.append(
            f"latency: {p50:.1f} ms p50, {p99:.1f} ms p99 (mid-exposure of the newest frame to publication)"
        )
    return lines


def _describe(result: RobotScore) -> str:
    if np.isnan(result.rms_mm):
        return f"{result.robot}: never tracked"
    rotation = "" if np.isnan(result.rotation_deg) else f"rotation {result.rotation_deg:.2f} degrees RMS; "
    return (
        f"{result.robot}: position {result.rms_mm:.2f} mm RMS, {result.max_mm:.2f} mm max; {rotation}"
        f"tracked {100 * result.tracked:.1f} %; longest gap {result.gap_s:.2f} s; "
        f"squared error over claim {result.normalized:.2f}"
    )


class ResourceUsage:
    """The use of resources since this object was created.

    Args:
        pids: returns the process ids of the programs, besides this one.
        feed: connected to the arena.

    Attributes:
        peak_bytes: the most memory that all programs had together in a call of `measure`.
    """

    def __init__(self, pids: Callable[[], Iterable[int]], feed: Feed) -> None:
        self.start_ns, self._start = time.time_ns(), time.monotonic()
        self._pids, self._feed = pids, feed
        self.peak_bytes = 0
        self._processor_s = self.measure()
        self._counts = feed.state().message_counts

    def seconds(self) -> float:
        """Return the measured time, above 0."""
        return max(1e-3, time.monotonic() - self._start)

    def measure(self) -> float:
        """Update `peak_bytes`; return the processor time of this process and the running programs, seconds."""
        seconds, resident = 0.0, 0
        for pid in (None, *self._pids()):  # None is this process
            try:
                process = psutil.Process(pid)
                with process.oneshot():
                    times = process.cpu_times()
                    seconds += times.user + times.system
                    resident += process.memory_info().rss
            except psutil.Error:  # it has ended
                continue
        self.peak_bytes = max(self.peak_bytes, resident)
        return seconds

    def frame_rates(self, cameras: Iterable[str]) -> dict[str, float]:
        """Return the frames per second of each camera."""
        counts = self._feed.state().message_counts - self._counts
        return {name: counts[f"frames {name}"] / self.seconds() for name in cameras}

    def summarize(self, cameras: Iterable[str]) -> list[str]:
        """Return the lines of the summary."""
        rates = ", ".join(f"{name} {rate:.1f}" for name, rate in self.frame_rates(cameras).items())
        processor = (self.measure() - self._processor_s) / self.seconds()
        memory = f"peak memory {self.peak_bytes / 1e6:.0f} MB"
        return [
            f"frames/s: {rates}",
            f"all programs: {100 * processor:.0f} % of one processor, {memory}",
        ]


def describe_overload(rates: Mapping[str, float], usual: Mapping[str, float]) -> list[str]:
    """A line on the camera that lacks most frames, if this machine is too slow to simulate the cameras.

    Args:
        rates: frames per second, by camera.
        usual: those of a machine that is fast enough.
    """
    name = min(rates, key=lambda camera: rates[camera] / usual[camera])
    if rates[name] >= MIN_RATE * usual[name]:
        return []
    frames = f"camera {name} sent {rates[name]:.1f} of {usual[name]:.1f} frames/s"
    return [f"this machine is too busy or too slow for the demo: {frames}; end other programs and try again"]
