# SPDX-License-Identifier: BSD-3-Clause
"""Formats the state of an arena: tables for the panel, and one line for a terminal."""

import html
from collections import Counter
from dataclasses import dataclass

import numpy as np

from fusion.protocol.messages import CameraHealth, FusionStatus, Latency, RobotPose
from web.feed import ArenaState, TimedMessage

STALE_S = 2.0  # a robot or camera without a message for so long counts as absent
NO_VALUE = "–"
LEVEL_OF_STATE = {"tracked": "ok", "coasting": "warn"}  # other states are bad
COLOURS = {"ok": "#40c8aa", "warn": "#f0a63a", "bad": "#ef5b5b"}  # by level
MARGIN_PX = 6
CELL = "padding:3px 6px 3px 0"
MAX_SIGMA_MM = 1000  # a larger standard deviation has no meaning for a lost robot


@dataclass(frozen=True)
class TableRow:
    """The cells of a row, its level (a key of `COLOURS`), and a note, or "": a fault or an instruction."""

    cells: tuple[str, ...]
    level: str
    note: str = ""

    def html(self) -> str:
        """Return the row; the note has its own line, because a sentence does not fit beside figures."""
        cell = f'<td style="{CELL};white-space:nowrap">'
        texts = f"</td>{cell}".join(html.escape(text) for text in self.cells)
        row = f'<tr style="border-top:1px solid #8883">{cell}{_dot(self.level)}{texts}</td></tr>'
        style = f"white-space:normal;line-height:1.3;padding:0 0 4px 14px;color:{COLOURS[self.level]}"
        note = f'<tr><td colspan="{len(self.cells)}" style="{style}">{html.escape(self.note)}</td></tr>'
        return row + (note if self.note else "")


@dataclass(frozen=True)
class HtmlTable:
    """Rows under a header; `placeholder` stands for no rows."""

    header: tuple[str, ...]
    rows: list[TableRow]
    placeholder: str = "none"

    def html(self) -> str:
        """Return the table, with all texts escaped."""
        if not self.rows:
            text = html.escape(self.placeholder)
            return f'<div style="margin:0 {MARGIN_PX}px;font-size:11px;opacity:.6">{text}</div>'
        head = f'</th><th style="{CELL}">'.join(html.escape(text) for text in self.header)
        body = "".join(row.html() for row in self.rows)
        size = f"width:calc(100% - {2 * MARGIN_PX}px);margin:0 {MARGIN_PX}px"
        style = f"{size};border-collapse:collapse;font-size:11px;text-align:left"
        return (
            f'<table style="{style}"><tr style="opacity:.6;vertical-align:bottom;line-height:1.2">'
            f'<th style="{CELL}">{head}</th></tr>{body}</table>'
        )


def robot_state(state: ArenaState, robot: str) -> str:
    """Return the tracking state in a robot's latest pose, or "no data" if the pose is too old."""
    timed = state.poses[robot]
    return "no data" if state.age_s(timed) > STALE_S else timed.message.state


def tabulate_robots(state: ArenaState) -> HtmlTable:
    """One row per robot: state, position, speed, standard deviation of the position, number of markers."""
    status: FusionStatus | None = state.status.message if state.status else None
    missing = status.not_acquired if status else {}
    rows = [
        _robot_row(state, name) if name in state.poses else _missing_row(state, name)
        for name in sorted({*state.poses, *missing})
    ]
    return HtmlTable(("robot", "state", "x y z m", "m/s", "σ mm", "seen"), rows, "no robot yet")


def _missing_row(state: ArenaState, name: str) -> TableRow:
    """A robot that was never acquired."""
    return TableRow((name, "not found", *[NO_VALUE] * 4), "bad", _robot_note(state, name))


def _robot_note(state: ArenaState, name: str) -> str:
    """What the operator should know about a robot."""
    status: FusionStatus | None = state.status.message if state.status else None
    if status is None:
        return ""
    notes = [status.not_acquired.get(name, "")]
    if misfit_px := status.geometry_residuals_px.get(name):
        notes.append(f"the markers differ from their definition by {misfit_px:.1f} px: measure them again")
    if name in status.unsaved_robots:
        notes.append("not saved: a restart of the server loses it")
    return "; ".join(filter(None, notes))


def _robot_row(state: ArenaState, name: str) -> TableRow:
    pose: RobotPose = state.poses[name].message
    tracking = robot_state(state, name)
    position = " ".join(f"{x:+.2f}" for x in pose.position)
    speed, sigma = float(np.linalg.norm(pose.velocity)), format_sigma(position_sigma_mm(pose))
    cells = (name, tracking, position, f"{speed:.2f}", sigma, str(pose.n_markers))
    level = LEVEL_OF_STATE.get(tracking, "bad")
    note = _robot_note(state, name)
    return TableRow(cells, "warn" if note and level == "ok" else level, note)


def format_sigma(sigma_mm: float) -> str:
    """Format a standard deviation in millimetres; that of a lost robot grows without limit."""
    return f"{sigma_mm:.1f}" if sigma_mm < MAX_SIGMA_MM else "> 1 m"


def position_sigma_mm(pose: RobotPose) -> float:
    """Return the standard deviation of the position, RMS over x, y and z, millimetres."""
    return 1e3 * float(np.sqrt(max(0.0, np.diag(pose.covariance_matrix)[3:6].mean())))


def tabulate_cameras(state: ArenaState) -> HtmlTable:
    """One row per camera, from its own status and the server's.

    Columns: frames/s, detection time, roundels per frame, RMS reprojection error, time from mid-exposure to arrival,
    clock offset, lost frames (dropped by the camera / too late for the server).
    """
    server = state.status.message.cameras if state.status else {}
    rows = [_camera_row(state, name, server.get(name)) for name in sorted({*state.cameras, *server})]
    header = ("camera", "fps", "detect ms", "seen", "px", "late ms", "clock ms", "lost")
    return HtmlTable(header, rows, "no camera yet")


def _camera_row(state: ArenaState, name: str, health: CameraHealth | None) -> TableRow:
    timed = state.cameras.get(name)
    own = timed.message if timed else None
    advice = _advise(state, timed, health)
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
    return TableRow(cells, "bad" if advice == "offline" else "warn" if advice else "ok", advice)


def _advise(state: ArenaState, timed: TimedMessage | None, health: CameraHealth | None) -> str:
    if timed is None or state.age_s(timed) > STALE_S:
        return "offline"
    if health is not None and not health.calibrated:
        return "not calibrated"
    if health is not None and health.excluded:
        return "moved: excluded until it is recalibrated"
    if health is not None and health.clock == "excluded":
        return "its stamps jumped: excluded until they are corrected"
    if health is not None and health.clock == "corrected":
        return f"its stamps are corrected by {health.clock_correction_ms:.1f} ms: check its clock"
    if health is not None and health.duplicate_publisher:
        return "two nodes use this name"
    return timed.message.advice


def describe_server(state: ArenaState) -> str:
    """Return one line on the server."""
    if state.status is None or not state.server_alive:
        return "no server found yet" if state.status is None else "the server is offline"
    status: FusionStatus = state.status.message
    return (
        f"{status.frame_sets_per_s:.0f} poses/s, latency {_number(status.latency_ms, 1)} ms, "
        f"processor {100 * status.cpu:.0f} %, {status.memory_mb:.0f} MB"
    )


def describe_latency(state: ArenaState) -> str:
    """Return the parts of the latency from mid-exposure to the pose, the mean of all robots' latest poses."""
    recent = [timed.message.latency for timed in state.poses.values() if state.age_s(timed) < STALE_S]
    latencies = [latency for latency in recent if latency is not None]
    if not latencies:
        return ""
    parts = (
        f"{name.removesuffix('_ms')} {np.mean([getattr(latency, name) for latency in latencies]):.1f}"
        for name in Latency.__struct_fields__
        if name not in ("exposure_ms", "detect_ms")  # camera_ms includes them
    )
    return f"latency ms: {', '.join(parts)}"


def tabulate_faults(state: ArenaState) -> HtmlTable:
    """One row per reason for which the server or this viewer skipped something, and per camera where it is known."""
    status = state.status.message if state.status else None
    counts = Counter(status.faults if status else {})
    for name, health in status.cameras.items() if status else ():
        counts.subtract(health.faults)  # the remaining ones are of no known camera
        counts.update({f"{name}: {reason}": count for reason, count in health.faults.items()})
    counts.update({f"viewer: {reason}": count for reason, count in state.faults.items()})
    rows = [TableRow((reason, str(count)), "warn") for reason, count in counts.items() if count > 0]
    return HtmlTable(("fault", "count"), rows)


def describe_arena(state: ArenaState) -> str:
    """Return the whole state in one line, for terminals and logs."""
    cameras = [
        f"{row.cells[0]} {row.cells[1]} fps{_bracketed_note(row)}" for row in tabulate_cameras(state).rows
    ]
    robots = [
        f"{row.cells[0]} {row.cells[1]} at {row.cells[2]} ±{row.cells[4]} mm{_bracketed_note(row)}"
        for row in tabulate_robots(state).rows
    ]
    parts = [
        describe_server(state),
        ", ".join(cameras) or "no camera",
        f"{len(state.rig.placed()) if state.rig else 0} calibrated",
        ", ".join(robots) or "no robot",
        f"{sum(int(row.cells[1]) for row in tabulate_faults(state).rows)} faults",
    ]
    return " | ".join(parts)


def _number(value: float | None, digits: int) -> str:
    return NO_VALUE if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _bracketed_note(row: TableRow) -> str:
    return f" ({row.note})" if row.note else ""


def _dot(level: str) -> str:
    return f'<span style="color:{COLOURS[level]}">&#9679;</span> '
