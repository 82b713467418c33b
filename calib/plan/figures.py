# SPDX-License-Identifier: BSD-3-Clause
"""Draws the evaluation of an arena with matplotlib: maps of error and coverage, and the distribution of errors."""

from typing import Any

import numpy as np

from calib.plan.planner import PlanReport
from camera_node.foundation.arrays import Array
from camera_node.foundation.extras import require

LEVELS = 3  # maps, from the lowest to the highest level
ARROW_M = 0.6
BLIND = "#d8d8d8"
INK = "#28231e"
AXIS_COLOUR = "#c85a14"


def draw_errors(report: PlanReport) -> Any:
    """A figure with the expected error at up to three heights, seen from above."""
    errors = report.errors.position_mm.reshape(report.volume.shape)
    finite = errors[np.isfinite(errors)]
    low, high = np.quantile(finite, [0.0, 0.95]) if finite.size else (0.0, 1.0)
    limits = (float(low), max(float(high), float(low) + 1e-6))
    return _draw_levels(report, errors, "expected error, mm", limits, "viridis_r")


def draw_coverage(report: PlanReport) -> Any:
    """A figure with the number of cameras that detect a roundel at up to three heights, seen from above."""
    count = report.errors.cameras.reshape(report.volume.shape).astype(float)
    limits = (0.0, max(float(count.max()), 2.0))
    return _draw_levels(report, np.where(count < 1, np.nan, count), "cameras", limits, "YlGn")


def draw_distribution(report: PlanReport) -> Any:
    """A figure with the share of the volume by the largest error."""
    figure = _figure(6.4, 3.2)
    axes = figure.subplots()
    known = np.sort(report.errors.position_mm[report.covered])
    share = np.arange(1, len(known) + 1) / len(report.errors.cameras)
    axes.plot(known, share, color=INK)
    required = report.arena.plan.required
    if required is not None:
        axes.axvline(required.error_mm, color=AXIS_COLOUR, label=f"required {required.error_mm:g} mm")
        axes.axhline(
            required.share, color=AXIS_COLOUR, linestyle=":", label=f"{required.share:.0%} of the volume"
        )
        axes.legend(frameon=False, loc="lower right")
    axes.set(xlabel="expected error, mm", ylabel="share of the volume", ylim=(0, 1.02))
    axes.set_xlim(left=0)
    axes.grid(alpha=0.3)
    return figure


def _draw_levels(
    report: PlanReport, values: Array, label: str, limits: tuple[float, float], colours: str
) -> Any:
    volume = report.volume
    levels = np.unique(np.linspace(0, len(volume.z) - 1, LEVELS).round().astype(int))
    figure = _figure(4.2 * len(levels) + 0.9, 4.2)
    every = figure.subplots(1, len(levels), squeeze=False)[0]
    mesh = None
    for axes, level in zip(every, levels, strict=True):
        layer = np.ma.masked_invalid(values[level])
        axes.set_facecolor(BLIND)
        mesh = axes.pcolormesh(
            volume.x, volume.y, layer, vmin=limits[0], vmax=limits[1], cmap=colours, shading="nearest"
        )
        _draw_cameras(axes, report)
        axes.set(title=f"z = {volume.z[level]:.2f} m", xlabel="x, m", aspect="equal")
    every[0].set_ylabel("y, m")
    figure.colorbar(mesh, ax=list(every), label=label, extend="max", shrink=0.85)
    return figure


def _draw_cameras(axes: Any, report: PlanReport) -> None:
    for name, camera in report.arena.cameras.items():
        T = camera.matrix()
        x, y = T[:2, 3]
        axes.plot(x, y, "o", color=AXIS_COLOUR, markersize=5)
        axes.annotate(
            "", (x + ARROW_M * T[0, 2], y + ARROW_M * T[1, 2]), (x, y), arrowprops={"arrowstyle": "->"}
        )
        axes.annotate(name, (x, y), xytext=(4, 4), textcoords="offset points", fontsize=7, color=INK)
    x0, y0, x1, y1 = report.arena.plan.area_m
    axes.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color=INK, linewidth=0.8)


def _figure(width: float, height: float) -> Any:
    """A figure without a window system."""
    module = require("matplotlib.figure", "plan", "the report")
    return module.Figure(figsize=(width, height), layout="constrained")
