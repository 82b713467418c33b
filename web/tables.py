# SPDX-License-Identifier: BSD-3-Clause
"""What the panel's tables and the status line say of an arena."""

import html
from dataclasses import dataclass

import numpy as np

from fusion.protocol.messages import CameraHealth, FusionStatus, Latency, RobotPose
from web.feed import Latest, Seen

STALE_S = 2.0  # a robot or a camera that was silent for so long is away
NONE = "–"
HUE_OF = {"tracked": "ok", "coasting": "warn"}  # of a robot's state; else bad
MARGIN_PX = 6
CELL = "padding:3px 6px 3px 0"
HUES = {"ok": "#40c8aa", "warn": "#f0a63a", "bad": "#ef5b5b"}


@dataclass(frozen=True)
class Row:
    """A table's cells; how what they tell of does, a hue of `HUES`; and what to know or do about it, if anything."""

    cells: tuple[str, ...]
    hue: str
    note: str = ""

    def html(self) -> str:
        """The row, its note on a line of its own: a sentence has no width to share with figures."""
        cell = f'<td style="{CELL};white-space:nowrap">'
        texts = f"</td>{cell}".join(html.escape(text) for text in self.cells)
        row = f'<tr style="border-top:1px solid #8883">{cell}{_dot(self.hue)}{texts}</td></tr>'
        style = f"white-space:normal;line-height:1.3;padding:0 0 4px 14px;color:{HUES[self.hue]}"
        note = f'<tr><td colspan="{len(self.cells)}" style="{style}">{html.escape(self.note)}</td></tr>'
        return row + (note if self.note else "")


@dataclass(frozen=True)
class Table:
    """Rows under a header; `nothing` is told where there are none."""

    header: tuple[str, ...]
    rows: list[Row]
    nothing: str = "none"

    def html(self) -> str:
        """The table for the panel; whatever the network said is escaped."""
        if not self.rows:
            return f'<div style="margin:0 {MARGIN_PX}px;font-size:11px;opacity:.6">{html.escape(self.nothing)}</div>'
        head = f'</th><th style="{CELL}">'.join(html.escape(text) for text in self.header)
        body = "".join(row.html() for row in self.rows)
        place = f"width:calc(100% - {2 * MARGIN_PX}px);margin:0 {MARGIN_PX}px"
        style = f"{place};border-collapse:collapse;font-size:11px;text-align:left"
        return (
            f'<table style="{style}"><tr style="opacity:.6;vertical-align:bottom;line-height:1.2">'
            f'<th style="{CELL}">{head}</th></tr>{body}</table>'
        )


def robot_state(latest: Latest, robot: str) -> str:
    """The state that a robot's newest pose tells, or "away" when it is too old to tell one."""
    seen = latest.poses[robot]
    return "away" if latest.age(seen) > STALE_S else seen.message.state


def tabulate_robots(latest: Latest) -> Table:
    """One row a robot: state, position (m), speed (m/s) and one standard deviation of the position (mm)."""
    misfits = latest.status.message.geometry_residuals_px if latest.status else {}
    rows = [_robot_row(latest, name, misfits.get(name)) for name in sorted(latest.poses)]
    return Table(("robot", "state", "x y z m", "m/s", "σ mm", "seen"), rows, "no robot yet")


def _robot_row(latest: Latest, name: str, misfit: float | None) -> Row:
    pose: RobotPose = latest.poses[name].message
    state = robot_state(latest, name)
    place = " ".join(f"{x:+.2f}" for x in pose.position)
    speed, sigma = float(np.linalg.norm(pose.velocity)), describe_sigma(position_sigma_mm(pose))
    cells = (name, state, place, f"{speed:.2f}", sigma, str(pose.n_markers))
    hue = HUE_OF.get(state, "bad")
    if misfit is None:
        return Row(cells, hue)
    return Row(
        cells, "warn" if hue == "ok" else hue, f"its markers are off by {misfit:.1f} px: measure them again"
    )


def describe_sigma(sigma_mm: float) -> str:
    """Millimetres; a robot that has long been lost may be anywhere."""
    return f"{sigma_mm:.1f}" if sigma_mm < 1000 else "> 1 m"


def position_sigma_mm(pose: RobotPose) -> float:
    """Root mean square over x, y, z of the position's standard deviation, millimetres."""
    return 1e3 * float(np.sqrt(max(0.0, np.diag(pose.covariance_matrix)[3:6].mean())))


def tabulate_cameras(latest: Latest) -> Table:
    """One row a camera: what its node says of it, and what the server sees of it.

    The columns: frames a second, time to detect, roundels a frame, RMS of the reprojection, middle of the exposure
    to arrival, clock offset, frames lost (dropped at the camera / too late for the server).
    """
    server = latest.status.message.cameras if latest.status else {}
    rows = [_camera_row(latest, name, server.get(name)) for name in sorted({*latest.cameras, *server})]
    header = ("camera", "fps", "detect ms", "seen", "px", "late ms", "clock ms", "lost")
    return Table(header, rows, "no camera yet")


def _camera_row(latest: Latest, name: str, health: CameraHealth | None) -> Row:
    seen = latest.cameras.get(name)
    own = seen.message if seen else None
    advice = _advise(latest, seen, health)
    cells = (
        name,
        _number(own and own.fps, 1),
        _number(own and own.detect_ms, 2),
        _number(own and own.roundels, 1),
        _number(health and health.residual_px, 2),
        _number(health and health.lateness_ms, 1),
        _number(own and own.clock_offset_ms, 2),
        f"{own.dropped if own else 0} / {health.late if health else 0}",
    )
    return Row(cells, "bad" if advice == "away" else "warn" if advice else "ok", advice)


def _advise(latest: Latest, seen: Seen | None, health: CameraHealth | None) -> str:
    if seen is None or latest.age(seen) > STALE_S:
        return "away"
    if health is not None and not health.calibrated:
        return "not placed"
    if health is not None and health.excluded:
        return "moved: excluded until it is recalibrated"
    if health is not None and health.duplicate_publisher:
        return "two nodes have this name"
    return seen.message.advice


def describe_server(latest: Latest) -> str:
    """One line on the server."""
    if latest.status is None or not latest.server_alive:
        return "no server answers yet" if latest.status is None else "the server is away"
    status: FusionStatus = latest.status.message
    return (
        f"{status.frame_sets_per_s:.0f} poses/s, latency {_number(status.latency_ms, 1)} ms, "
        f"processor {100 * status.cpu:.0f} %, {status.memory_mb:.0f} MB"
    )


def describe_latency(latest: Latest) -> str:
    """Where the time goes from the newest exposure's middle to the pose, by the mean of all robots' newest poses."""
    told = [seen.message.latency for seen in latest.poses.values() if latest.age(seen) < STALE_S]
    told = [latency for latency in told if latency is not None]
    if not told:
        return ""
    parts = (
        f"{name.removesuffix('_ms')} {np.mean([getattr(latency, name) for latency in told]):.1f}"
        for name in Latency.__struct_fields__
        if name not in ("exposure_ms", "detect_ms")  # parts of the camera's
    )
    return f"latency ms: {', '.join(parts)}"


def list_faults(latest: Latest) -> Table:
    """What the server and this viewer skipped, by its reason."""
    server = latest.status.message.faults if latest.status else {}
    counts = [(reason, count) for reason, count in server.items() if count]
    counts += [(f"viewer: {reason}", count) for reason, count in latest.faults.items()]
    return Table(("skipped", "times"), [Row((reason, str(count)), "warn") for reason, count in counts])


def describe(latest: Latest) -> str:
    """All of it in one line, for terminals and logs."""
    cameras = [f"{row.cells[0]} {row.cells[1]} fps{_noted(row)}" for row in tabulate_cameras(latest).rows]
    robots = [
        f"{row.cells[0]} {row.cells[1]} at {row.cells[2]} ±{row.cells[4]} mm{_noted(row)}"
        for row in tabulate_robots(latest).rows
    ]
    faults = sum(int(row.cells[1]) for row in list_faults(latest).rows)
    placed = len(latest.rig.placed()) if latest.rig else 0
    parts = [
        describe_server(latest),
        ", ".join(cameras) or "no camera",
        f"{placed} placed",
        ", ".join(robots) or "no robot",
        f"{faults} faults",
    ]
    return " | ".join(parts)


def _number(value: float | None, digits: int) -> str:
    return NONE if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _noted(row: Row) -> str:
    return f" ({row.note})" if row.note else ""


def _dot(hue: str) -> str:
    return f'<span style="color:{HUES[hue]}">&#9679;</span> '
