# SPDX-License-Identifier: BSD-3-Clause
"""Writes the evaluation of an arena as one HTML or PDF file with figures."""

import base64
import io
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from calib.plan.figures import draw_coverage, draw_distribution, draw_errors
from calib.plan.planner import PlanReport
from calib.plan.summary import PlanSummary, describe, summarize
from camera_node.foundation.config import write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.extras import require

SUFFIXES = (".html", ".pdf")
PAGE_INCH = (8.27, 11.69)
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #28231e; max-width: 70rem; margin: 2rem auto; padding: 0 1rem }
table { border-collapse: collapse; margin: 1rem 0 } td, th { padding: .25rem .8rem; text-align: right }
th { border-bottom: 1px solid #888 } td:first-child, th:first-child { text-align: left }
img { max-width: 100%; display: block; margin: 1rem 0 } .met { color: #1a7f37 } .missed { color: #b42318 }
"""


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
