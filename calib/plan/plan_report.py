# SPDX-License-Identifier: BSD-3-Clause
"""Writes the evaluation of an arena as one HTML or PDF file, with figures by matplotlib: maps of error and coverage,
and the distribution of errors."""

import base64
import io
import textwrap
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from calib.plan.plan_summary import describe
from calib.plan.planner import PlanReport
from camera_node.foundation.arrays import Array
from camera_node.foundation.config import write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.extras import require

LEVELS = 3  # maps, from the lowest to the highest level
ARROW_M = 0.6
INK = "#28231e"
AXIS_COLOUR = "#c85a14"
SUFFIXES = (".html", ".pdf")


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
        axes.set_facecolor("#d8d8d8")  # blind places
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


def check_report(path: Path) -> None:
    """Raise ConfigError unless a report can be written to `path`; called before any work is done."""
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{path} is neither .html nor .pdf; give --report a file such as plan.html")
    if not path.parent.is_dir():
        raise ConfigError(f"{path.parent} is not a folder; give --report a file in a folder that exists")
    require("matplotlib", "plan", "the report")


def write_report(report: PlanReport, path: Path, title: str) -> None:
    """Write the report as HTML or PDF, by the suffix of `path`.

    Raises:
        ConfigError: the file can't be written.
    """
    if path.suffix.lower() == ".pdf":
        _write_pdf(report, path, title)
    else:
        write_atomically(path, _html(report, title))


def _html(report: PlanReport, title: str) -> str:
    """The page: what is printed, and the figures, which are part of it."""
    images = "".join(
        f"<h2>{heading}</h2><img alt='{heading}' style='max-width: 100%' src='data:image/png;base64,{_png(figure)}'>"
        for heading, figure in _figures(report)
    )
    text = escape("\n".join(describe(report)))
    return (
        f"<!doctype html><html lang='en'><meta charset='utf-8'><title>{escape(title)}</title><h1>{escape(title)}</h1>"
        f"<pre style='white-space: pre-wrap'>{text}</pre>{images}"
        "<p>Errors are root mean square distances between a robot's position and its estimate from one frame set. "
        "Range: Faigl, Krajnik, Chudoba and Saska, ICRA 2013, Section IV.</p></html>"
    )


def _figures(report: PlanReport) -> Sequence[tuple[str, Any]]:
    return (
        ("Expected error", draw_errors(report)),
        ("Cameras per place", draw_coverage(report)),
        ("Share of the volume by error", draw_distribution(report)),
    )


def _png(figure: Any) -> str:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    return base64.b64encode(data.getvalue()).decode()


def _write_pdf(report: PlanReport, path: Path, title: str) -> None:
    """A page of text, then one page for each figure."""
    backend = require("matplotlib.backends.backend_pdf", "plan", "the report")
    figure = require("matplotlib.figure", "plan", "the report").Figure(figsize=(8.27, 11.69))  # A4, inches
    text = "\n".join([title, "", *(line for full in describe(report) for line in textwrap.wrap(full, 110))])
    figure.text(0.06, 0.96, text, va="top", family="monospace", fontsize=7)
    data = io.BytesIO()
    with backend.PdfPages(data) as pages:
        for page in (figure, *(drawn for _, drawn in _figures(report))):
            pages.savefig(page)
    write_atomically(path, data.getvalue())
