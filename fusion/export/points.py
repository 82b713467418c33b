# SPDX-License-Identifier: BSD-3-Clause
"""The robots' origins and markers at a constant rate, as C3D and TRC need them.

Between two poses a point moves on the cubic that has its positions and velocities at both (Hermite). The error is
at most h^4 / 384 of the fourth derivative of the motion, with poses every h seconds.
"""

from array import array
from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import rotation_from_wxyz
from fusion.export.recorded_poses import RecordedPoses

MAX_VALUES = 100_000_000  # coordinates of one file
GAP = 2.5  # periods of the poses that may be between two of them; a longer gap has no points
COLUMNS = 13  # of a pose: position, quaternion, velocity, angular velocity


@dataclass(frozen=True)
class PointTrajectories:
    """Points at a constant rate.

    Attributes:
        labels: N names: `rover` is the body's origin, `rover_1` its first marker.
        rate_hz: frames a second.
        start_ns: server's Unix time of the first frame.
        points: (F, N, 3) in the world, metres; NaN where the robot was lost.
    """

    labels: list[str]
    rate_hz: float
    start_ns: int
    points: Array


def sample_points(poses: RecordedPoses, rate_hz: float | None = None) -> PointTrajectories:
    """Sample the robots' points at a constant rate.

    Args:
        poses: a recording.
        rate_hz: frames a second; the rate of the poses, rounded to a whole number, unless given.

    Raises:
        ConfigError: there are fewer than two poses, the rate is implausible, or the file would be too large.
    """
    times: dict[str, array[int]] = {}
    rows: dict[str, array[float]] = {}
    for pose in poses:
        if pose.state != "lost":
            times.setdefault(pose.robot, array("q")).append(pose.t_ns)
            numbers = (*pose.position, *pose.quaternion_wxyz, *pose.velocity, *pose.angular_velocity)
            rows.setdefault(pose.robot, array("d")).extend(numbers)
    stamps = {robot: np.frombuffer(t, np.int64) for robot, t in times.items() if len(t) >= 2}
    if not stamps:
        raise ConfigError(f"{poses.path} holds fewer than two poses of a robot that is not lost")
    period_ns = float(np.median(np.concatenate([np.diff(t) for t in stamps.values()])))
    rate_hz = max(1.0, round(1e9 / period_ns)) if rate_hz is None else rate_hz
    start_ns = int(min(t[0] for t in stamps.values()))
    seconds = 1e-9 * (int(max(t[-1] for t in stamps.values())) - start_ns)
    bodies = {robot: _body_points(poses, robot) for robot in stamps}
    n_points = sum(len(body) for body in bodies.values())
    if not (0.1 <= rate_hz <= 1000 and seconds * rate_hz * n_points * 3 <= MAX_VALUES):
        raise ConfigError(
            f"{seconds:.0f} s at {rate_hz:g} Hz with {n_points} points are too much; "
            "give a lower --rate-hz or fewer --robots"
        )
    grid = (
        np.round(np.arange(int(seconds * rate_hz + 1e-6) + 1) * (1e9 / rate_hz)).astype(np.int64) + start_ns
    )
    sampled = [
        _sample(stamps[robot], np.frombuffer(rows[robot]).reshape(-1, COLUMNS), body, (grid, GAP * period_ns))
        for robot, body in bodies.items()
    ]
    labels = [f"{robot}_{k}" if k else robot for robot, body in bodies.items() for k in range(len(body))]
    return PointTrajectories(labels, rate_hz, start_ns, np.concatenate(sampled, axis=1))


def _body_points(poses: RecordedPoses, robot: str) -> Array:
    """(N, 3) the body's origin and markers, body frame."""
    body = poses.bodies.get(robot)
    return np.vstack([np.zeros((1, 3)), body.points]) if body else np.zeros((1, 3))


def _sample(times: np.ndarray, rows: Array, body: Array, grid: tuple[np.ndarray, float]) -> Array:
    """(F, N, 3) a robot's points.

    Args:
        times: (P,) of its poses, ns.
        rows: (P, 13) its poses.
        body: (N, 3) its points in the body's frame.
        grid: (F,) the times of the samples, ns, and the longest gap between two poses, ns.
    """
    wanted, gap_ns = grid
    lever = np.einsum("pij,nj->pni", rotation_from_wxyz(rows[:, 3:7]), body)
    points = rows[:, None, 0:3] + lever
    velocities = rows[:, None, 7:10] + np.cross(rows[:, None, 10:13], lever)
    left = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, len(times) - 2)
    h_s = 1e-9 * (times[left + 1] - times[left])
    u = 1e-9 * (wanted - times[left]) / h_s
    is_inside = (u >= 0) & (u <= 1) & (h_s <= 1e-9 * gap_ns)
    is_inside |= np.isin(wanted, times)
    u, h_s = u[:, None, None], h_s[:, None, None]
    p, q, v, w = points[left], points[left + 1], velocities[left] * h_s, velocities[left + 1] * h_s
    sampled = p + u * (v + u * (3 * (q - p) - 2 * v - w + u * (2 * (p - q) + v + w)))
    sampled[~is_inside] = np.nan
    return sampled
