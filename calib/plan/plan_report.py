# SPDX-License-Identifier: BSD-3-Clause
"""Writes the evaluation of an arena as one HTML or PDF file, with figures by matplotlib: maps of error and coverage,
and the distribution of errors."""

import base64
import io
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from calib.plan.plan_summary import PlanSummary, describe, summarize
from calib.plan.planner import PlanReport
from camera_node.foundation.arrays import Array
from camera_node.foundation.config import write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.extras import require

LEVELS = 3  # maps, from the lowest to the highest level
ARROW_M = 0.6
BLIND = "#d8d8d8"
INK = "#28231e"
AXIS_COLOUR = "#c85a14"
SUFFIXES = (".html", ".pdf")
PAGE_INCH = (8.27, 11.69)
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #28231e; max-width: 70rem; margin: 2rem auto; padding: 0 1rem }
table { border-collapse: collapse; margin: 1rem 0 } td, th { padding: .25rem .8rem; text-align: right }
th { border-bottom: 1px solid #888 } td:first-child, th:first-child { text-align: left }
img { max-width: 100%; display: block; margin: 1rem 0 } .met { color: #1a7f37 } .missed { color: #b42318 }
"""


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
    """The page; its pictures are part of it."""
    summary = summarize(report)
    images = "".join(
        f"<h2>{heading}</h2><img alt='{heading}' src='data:image/png;base64,{_png(figure)}'>"
        for heading, figure in _figures(report)
    )
    return (
        f"<!doctype html><html lang='en'><meta charset='utf-8'><title>{escape(title)}</title><style>{STYLE}</style>"
        f"<h1>{escape(title)}</h1>{_verdict(summary)}{_table(_overview(summary))}{images}"
        f"<h2>Cameras</h2>{_table(_camera_rows(summary))}<h2>Blind spots</h2>{_blind(report)}"
        "<p>Errors are root mean square distances between a robot's position and its estimate from one frame set. "
        "Range: Faigl, Krajnik, Chudoba and Saska, ICRA 2013, Section IV.</p></html>"
    )


def _figures(report: PlanReport) -> Sequence[tuple[str, Any]]:
    return (
        ("Expected error", draw_errors(report)),
        ("Cameras per place", draw_coverage(report)),
        ("Share of the volume by error", draw_distribution(report)),
    )


def _overview(summary: PlanSummary) -> list[tuple[str, ...]]:
    return [
        ("", "value"),
        ("two cameras or more see", f"{summary.covered:.1%} of the volume"),
        ("one camera sees", f"{summary.single:.1%}"),
        ("expected error, median", _with_unit(summary.median_error_mm, "mm")),
        ("expected error, 95 % quantile", _with_unit(summary.p95_error_mm, "mm")),
        ("orientation, median", _with_unit(summary.median_orientation_deg, "degrees")),
        ("rate", f"{summary.fastest_hz:g} Hz"),
        ("detections", f"{summary.detections_s:.0f} a second"),
        ("network load of the server", f"{summary.network_bit_s / 1e6:.2f} Mbit/s"),
    ]


def _camera_rows(summary: PlanSummary) -> list[tuple[str, ...]]:
    header = ("camera", "x, m", "y, m", "z, m", "nearest, m", "farthest, m", "sees", "Hz", "kbit/s")
    rows = [
        (
            name,
            *(f"{x:.2f}" for x in camera.position_m),
            f"{camera.v_min_m:.2f}",
            f"{camera.v_max_m:.2f}",
            f"{camera.share:.0%}",
            f"{camera.fps:g}",
            f"{camera.bit_s / 1e3:.0f}",
        )
        for name, camera in summary.cameras.items()
    ]
    return [header, *rows]


def _verdict(summary: PlanSummary) -> str:
    if summary.is_sufficient is None:
        return ""
    kind, word = ("met", "is met") if summary.is_sufficient else ("missed", "is not met")
    return (
        f"<p class='{kind}'>The requirement of {summary.required_error_mm:g} mm in {summary.required_share:.0%} of the "
        f"volume {word}: {summary.share_within_required:.1%}.</p>"
    )


def _blind(report: PlanReport) -> str:
    if not report.blind:
        return "<p>None: at least two cameras see every place.</p>"
    return "<ul>" + "".join(f"<li>{escape(region.describe())}</li>" for region in report.blind) + "</ul>"


def _table(rows: Sequence[Sequence[str]]) -> str:
    """A table with a header row, of plain text."""
    head, *body = rows
    lines = ["".join(f"<th>{escape(cell)}</th>" for cell in head)]
    lines += ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in body]
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"


def _with_unit(value: float | None, unit: str) -> str:
    return "not known" if value is None else f"{value:.2f} {unit}"


def _png(figure: Any) -> str:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    return base64.b64encode(data.getvalue()).decode()


def _write_pdf(report: PlanReport, path: Path, title: str) -> None:
    """A page of text, then one page for each figure."""
    backend = require("matplotlib.backends.backend_pdf", "plan", "the report")
    figure = require("matplotlib.figure", "plan", "the report").Figure(figsize=PAGE_INCH)
    text = "\n".join([title, "", *(line for full in describe(report) for line in _wrap(full))])
    figure.text(0.06, 0.96, text, va="top", family="monospace", fontsize=7)
    data = io.BytesIO()
    with backend.PdfPages(data) as pages:
        for page in (figure, *(drawn for _, drawn in _figures(report))):
            pages.savefig(page)
    write_atomically(path, data.getvalue())


def _wrap(line: str, columns: int = 110) -> list[str]:
    return [line[k : k + columns] for k in range(0, len(line), columns)] or [""]
