# SPDX-License-Identifier: BSD-3-Clause
"""Draws a recording: trajectories, positions with their uncertainty, and the residuals of each camera."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.rig.camera import Camera
from calib.rig.recording import read_decoded
from camera_node.foundation.arrays import Array
from camera_node.foundation.config import new_path
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.extras import require
from fusion.export.recorded_poses import MM, RecordedPoses
from fusion.protocol.pose_messages import FusionStatus, RobotPose

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_POINTS = 1 << 12  # of a curve: twice as many as a page has pixels; 50 robots with 16,384 took 600 MB
SUFFIXES = (".png", ".pdf", ".svg")
ARROW_M = 0.4  # the length of a camera's optical axis in the top view
AXES = "xyz"


class Curve:
    """Rows of numbers over time, of which every 2^k-th is kept, so that any length fits.

    Attributes:
        t_ns: the times of the rows that are kept.
        rows: the rows.
    """

    def __init__(self) -> None:
        self.t_ns: list[int] = []
        self.rows: list[Sequence[float]] = []
        self._stride = 1
        self._count = 0

    def add(self, t_ns: int, row: Sequence[float]) -> None:
        """Add the next row."""
        if self._count % self._stride == 0:
            self.t_ns.append(t_ns)
            self.rows.append(row)
        self._count += 1
        if len(self.rows) == MAX_POINTS:
            self.t_ns, self.rows = self.t_ns[::2], self.rows[::2]
            self._stride *= 2


@dataclass
class RecordedCurves:
    """What is drawn of a recording.

    Attributes:
        path: the recording.
        robots: rows of x, y, z (m) and their standard deviations (m) by robot; NaN while the robot is lost.
        residuals: rows of the RMS reprojection error (px) by camera, once a second.
        cameras: of the rig that was recorded last.
        faults: what was skipped, counted by reason.
    """

    path: Path
    robots: dict[str, Curve] = field(default_factory=dict)
    residuals: dict[str, Curve] = field(default_factory=dict)
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    faults: Counter[str] = field(default_factory=Counter)

    @property
    def colours(self) -> dict[str, str]:
        """The colour of each robot in all drawings: matplotlib's, in the order of names."""
        return {name: f"C{k}" for k, name in enumerate(sorted(self.robots))}

    @property
    def start_ns(self) -> int:
        """The time of the first pose."""
        return min(curve.t_ns[0] for curve in self.robots.values())


def read_curves(path: Path, robots: Sequence[str] = ()) -> RecordedCurves:
    """Read what is drawn of a recording.

    Args:
        path: the MCAP file.
        robots: names of the robots to read; all unless given.

    Raises:
        ConfigError: the file is missing or no recording, or holds no poses of these robots.
    """
    poses = RecordedPoses(path, robots)
    curves = RecordedCurves(path, faults=poses.faults)
    for pose in poses:
        curves.robots.setdefault(pose.robot, Curve()).add(pose.t_ns, _row(pose))
    curves.cameras = poses.cameras
    for _, status in read_decoded(path, {"/fusion/status": FusionStatus}, Counter()):
        for camera, health in status.cameras.items():
            row = [np.nan if health.residual_px is None else health.residual_px]
            curves.residuals.setdefault(camera, Curve()).add(status.t_ns, row)
    return curves


def _row(pose: RobotPose) -> list[float]:
    if pose.state == "lost":
        return [np.nan] * 6
    variances = pose.covariance_matrix.diagonal()[3:6]
    return [*pose.position, *np.sqrt(np.maximum(variances, 0.0))]


def draw_recording(curves: RecordedCurves) -> "Figure":
    """Draw a recording on one page.

    Returns:
        a figure with the trajectories seen from above, the position of each robot over time with a band of two standard
        deviations, the standard deviations, and the residuals of the cameras.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    figure = require("matplotlib.figure", "plot", "A plot").Figure(figsize=(13, 9), layout="constrained")
    figure.suptitle(curves.path.name)
    left, right = figure.subfigures(1, 2)
    top, residuals = left.subplots(2, 1, height_ratios=(2, 1))
    *positions, sigmas = right.subplots(4, 1, sharex=True)
    _draw_top_view(top, curves)
    _draw_residuals(residuals, curves)
    for k, axes in enumerate(positions):
        _draw_position(axes, curves, k)
    _draw_sigmas(sigmas, curves)
    right.legend(*positions[0].get_legend_handles_labels(), loc="outside upper center", ncols=6)
    return figure


def _draw_top_view(axes: "Axes", curves: RecordedCurves) -> None:
    for name, curve in curves.robots.items():
        x, y = np.array(curve.rows)[:, :2].T
        axes.plot(x, y, color=curves.colours[name], linewidth=1, label=name)
    for name, camera in curves.cameras.items():
        if camera.T_world_cam is not None:
            (x, y), ahead = camera.matrix()[:2, 3], ARROW_M * camera.matrix()[:2, 2]
            axes.annotate("", (x + ahead[0], y + ahead[1]), (x, y), arrowprops={"arrowstyle": "->"})
            axes.annotate(name, (x, y), xytext=(6, 6), textcoords="offset points", fontsize=8)
            axes.update_datalim([(x, y)])
    axes.autoscale_view()
    axes.set(title="from above", xlabel="x in m", ylabel="y in m", aspect="equal")
    axes.set_adjustable("datalim")


def _draw_position(axes: "Axes", curves: RecordedCurves, k: int) -> None:
    for name, seconds, rows in _arrays(curves.robots, curves.start_ns):
        colour = curves.colours[name]
        axes.plot(seconds, rows[:, k], color=colour, linewidth=1, label=name)
        low, high = rows[:, k] - 2 * rows[:, 3 + k], rows[:, k] + 2 * rows[:, 3 + k]
        axes.fill_between(seconds, low, high, color=colour, alpha=0.25, linewidth=0)
    axes.set(ylabel=f"{AXES[k]} in m")


def _draw_sigmas(axes: "Axes", curves: RecordedCurves) -> None:
    for name, seconds, rows in _arrays(curves.robots, curves.start_ns):
        axes.plot(seconds, MM * rows[:, 3:].max(axis=1), color=curves.colours[name], linewidth=1)
    axes.set(yscale="log", xlabel="time in s", ylabel="1 sigma, worst axis, mm")


def _draw_residuals(axes: "Axes", curves: RecordedCurves) -> None:
    for name, seconds, rows in _arrays(curves.residuals, curves.start_ns):
        axes.plot(seconds, rows[:, 0], marker=".", linewidth=1, label=name)
    if curves.residuals:
        axes.legend(fontsize=8)
    else:
        axes.text(
            0.5, 0.5, "no states of the server in this recording", ha="center", transform=axes.transAxes
        )
    axes.set(
        title="reprojection error of each camera", xlabel="time in s", ylabel="RMS in px", ylim=(0, None)
    )


def _arrays(curves: Mapping[str, Curve], start_ns: int) -> list[tuple[str, Array, Array]]:
    """The name, times (s) and rows of each curve."""
    return [
        (name, (np.array(curve.t_ns, np.int64) - start_ns) / 1e9, np.array(curve.rows, float))
        for name, curve in sorted(curves.items())
    ]


def draw_comparison(first: RecordedCurves, second: RecordedCurves) -> "Figure":
    """Draw how far the positions of two recordings of the same experiment are apart, over time and for each robot.

    The second recording's positions are interpolated linearly at the first one's times.

    Raises:
        ConfigError: the recordings have no robot in common at the same time, or matplotlib is not installed.
    """
    figure = require("matplotlib.figure", "plot", "A plot").Figure(figsize=(11, 6), layout="constrained")
    axes = figure.subplots()
    for name, seconds, millimetres in compare_positions(first, second):
        rms = float(np.sqrt(np.nanmean(millimetres**2)))
        axes.plot(
            seconds, millimetres, color=first.colours[name], linewidth=1, label=f"{name}: RMS {rms:.2f} mm"
        )
    axes.legend()
    axes.set(
        title=f"{first.path.name} and {second.path.name}",
        xlabel="time in s",
        ylabel="distance in mm",
        ylim=(0, None),
    )
    return figure


def compare_positions(first: RecordedCurves, second: RecordedCurves) -> list[tuple[str, Array, Array]]:
    """How far two recordings of the same experiment are apart.

    Returns:
        the name of each common robot, times in seconds since the first pose, and distances in mm; NaN where the robot
        is lost in one of both.

    Raises:
        ConfigError: the recordings have no robot in common at the same time.
    """
    others = {name: (t, rows) for name, t, rows in _arrays(second.robots, first.start_ns)}
    apart = []
    for name, seconds, rows in _arrays(first.robots, first.start_ns):
        if name in others:
            t, points = others[name]
            there = np.stack([np.interp(seconds, t, points[:, k], np.nan, np.nan) for k in range(3)], axis=1)
            distances = MM * np.linalg.norm(rows[:, :3] - there, axis=1)
            if np.isfinite(distances).any():
                apart.append((name, seconds, distances))
    if not apart:
        raise ConfigError(
            f"{first.path} and {second.path} have no robot in common at the same time; compare two results of one "
            "recording, such as two of roundel replay --out"
        )
    return apart


def write_figure(figure: Any, path: Path) -> None:
    """Write a figure in the format of the suffix of `path`.

    Raises:
        ConfigError: the suffix is unknown, or the file can't be written.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(
            f"{path} does not end in {', '.join(SUFFIXES)}; give --out a name such as monday.png"
        )
    with new_path(path) as part:
        figure.savefig(part, dpi=120)
