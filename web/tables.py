# SPDX-License-Identifier: BSD-3-Clause
"""Formats the state of an arena: tables for the panel, and one line for a terminal."""

from collections import Counter

import numpy as np

from camera_node.geometry.pose import rotation_from_wxyz
from fusion.protocol.pose_messages import CameraHealth, FusionStatus, Latency, RobotPose
from web.colours import css, robot_colour
from web.html_tables import Column, HtmlTable, TableRow
from web.state.feed import ArenaState

STALE_S = 2.0  # a robot or camera without a message for so long counts as absent
NO_VALUE = "–"
NO_ROBOT = "no robot yet"
ROBOT_COLUMNS = (
    Column("robot", explanation="the dot has the robot's colour in the scene"),
    Column(
        "state", explanation="tracked: seen now; coasting: predicted; lost: no pose; not found: never seen"
    ),
    Column("x  y  z", "m", "position of the robot's origin in the world"),
    Column("heading", "\N{DEGREE SIGN}", "of the x axis, counterclockwise from the world's, seen from above"),
    Column("speed", "m/s"),
    Column("\N{GREEK SMALL LETTER SIGMA}", "mm", "standard deviation of the position"),
    Column("seen", "", "markers seen in the latest frame set"),
)
CAMERA_COLUMNS = (
    Column("camera"),
    Column("rate", "1/s", "frames per second"),
    Column("detect", "ms", "time to find the roundels in a frame, at the camera"),
    Column("seen", "", "roundels in a frame, mean over one second"),
    Column("blur", "px", "of the roundels' edges: turn the focus ring until it is least; 0.4 to 1 is sharp"),
    Column("error", "px", "RMS distance between detections and their prediction"),
    Column("arrival", "ms", "time from the middle of the exposure to the arrival at the server"),
    Column("clock", "ms", "the server's time minus the clock of the camera's machine"),
    Column("lost", "", "frames since the start: skipped by the camera / too late for the server"),
)
LEVEL_OF_STATE = {"tracked": "ok", "coasting": "warn"}  # other states are bad
N_FIGURES = len(ROBOT_COLUMNS) - 2
MAX_HEADING_SIGMA = 30.0  # degrees; a larger one means that nothing shows the heading
MAX_SIGMA_MM = 1000  # a larger standard deviation has no meaning for a lost robot


def robot_state(state: ArenaState, robot: str) -> str:
    """Return the tracking state in a robot's latest pose, or "no data" if the pose is too old."""
    timed = state.poses[robot]
    return "no data" if state.age_s(timed) > STALE_S else timed.message.state


def tabulate_robots(state: ArenaState) -> HtmlTable:
    """One row per robot: state, position, speed, standard deviation of the position, number of markers."""
    rows = [
        _robot_row(state, name) if name in state.poses else _missing_row(state, name)
        for name in sorted({*state.poses, *state.declared_robots()})
    ]
    return HtmlTable(ROBOT_COLUMNS, rows, "no robot is declared; create one below")


def _missing_row(state: ArenaState, name: str) -> TableRow:
    """A robot that was never acquired."""
    cells = (name, "not found", *[NO_VALUE] * N_FIGURES)
    return TableRow(cells, "bad", _robot_note(state, name), css(robot_colour(name)))


def _robot_note(state: ArenaState, name: str) -> str:
    """What the operator should know about a robot."""
    status: FusionStatus | None = state.status.message if state.status else None
    if status is None:
        return ""
    notes = [status.not_acquired.get(name, "")]
    for found in status.contradictions:
        if found.kind == "robot" and name in found.names:
            notes.append(
                f"the markers differ from their definition by {found.size_mm:.1f} mm: measure them again"
            )
    if diameter_m := status.measured_diameters_m.get(name):
        notes.append(f"its discs measure {1e3 * diameter_m:.0f} mm, not as declared: define it again")
    if name in status.unsaved_robots:
        notes.append("not saved: a restart of the server loses it")
    return "; ".join(filter(None, notes))


def _robot_row(state: ArenaState, name: str) -> TableRow:
    pose: RobotPose = state.poses[name].message
    tracking = robot_state(state, name)
    level, note = LEVEL_OF_STATE.get(tracking, "bad"), _robot_note(state, name)
    figures = (NO_VALUE,) * N_FIGURES if tracking == "no data" else _figures(pose)
    level = "warn" if note and level == "ok" else level
    return TableRow((name, tracking, *figures), level, note, css(robot_colour(name)))


def _figures(pose: RobotPose) -> tuple[str, ...]:
    position = " ".join(f"{x:+.2f}" for x in pose.position)
    speed, sigma = float(np.linalg.norm(pose.velocity)), format_sigma(position_sigma_mm(pose))
    return position, _heading(pose), f"{speed:.2f}", sigma, str(pose.n_markers)


def _heading(pose: RobotPose) -> str:
    """Direction of the x axis in the world's x-y plane, degrees; unknown for a robot with one marker."""
    R = rotation_from_wxyz(pose.quaternion_wxyz)
    up = R[2]  # the world's z axis in the body's frame, which is that of the covariance
    sigma = np.degrees(np.sqrt(max(0.0, float(up @ pose.covariance_matrix[:3, :3] @ up))))
    return f"{heading_degrees(pose):+.0f}" if sigma < MAX_HEADING_SIGMA else NO_VALUE


def heading_degrees(pose: RobotPose) -> float:
    """Direction of the x axis in the world's x-y plane, counterclockwise from the world's."""
    R = rotation_from_wxyz(pose.quaternion_wxyz)
    return float(np.degrees(np.arctan2(R[1, 0], R[0, 0])))


def format_sigma(sigma_mm: float) -> str:
    """Format a standard deviation in millimetres; that of a lost robot grows without limit."""
    return f"{sigma_mm:.1f}" if sigma_mm < MAX_SIGMA_MM else "> 1 m"


def position_sigma_mm(pose: RobotPose) -> float:
    """Return the standard deviation of the position, RMS over x, y and z, millimetres."""
    return 1e3 * float(np.sqrt(max(0.0, np.diag(pose.covariance_matrix)[3:6].mean())))


def tabulate_cameras(state: ArenaState) -> HtmlTable:
    """One row per camera, from its own status and the server's.

    Columns: frames/s, detection time, roundels per frame, blur of their edges, RMS reprojection error, time from
    mid-exposure to arrival, clock offset, lost frames (dropped by the camera / too late for the server).
    """
    server = state.status.message.cameras if state.status else {}
    rows = [_camera_row(state, name, server.get(name)) for name in sorted({*state.cameras, *server})]
    return HtmlTable(CAMERA_COLUMNS, rows, "no camera yet; start one with roundel camera")


def _camera_row(state: ArenaState, name: str, health: CameraHealth | None) -> TableRow:
    timed = state.cameras.get(name)
    silence = camera_silence_s(state, name)
    if silence is not None:
        cells = (name, *[NO_VALUE] * (len(CAMERA_COLUMNS) - 1))
        return TableRow(cells, "bad", describe_silence(silence))
    own = timed.message if timed else None
    is_placed = state.rig is not None and name in state.rig.placed()
    advice = _advise(own.advice if own else "", health, is_placed)
    cells = (
        name,
        _number(own and own.fps, 1),
        _number(own and own.detect_ms, 1),
        _number(own and own.roundels, 1),
        _number(own and own.edge_blur_px, 1),
        _number(health and health.residual_px, 2),
        _number(health and health.lateness_ms, 1),
        _number(own and own.clock_offset_ms, 2),
        f"{own.dropped if own else 0} / {health.late if health else 0}",
    )
    return TableRow(cells, "warn" if advice else "ok", advice)


def camera_silence_s(state: ArenaState, name: str) -> float | None:
    """For how long a camera has sent no status, seconds: infinite if it never did; None while it sends.

    None too for a camera that the server does not list: it was renamed or forgotten, and disappears.
    """
    age, status_age = state.age_s(state.cameras.get(name)), state.age_s(state.status)
    is_listed = status_age > STALE_S or name in (state.status.message.cameras if state.status else {})
    return age if age > STALE_S and is_listed else None


def describe_silence(seconds: float) -> str:
    """What to do about a camera that sends nothing."""
    since = f"silent for {seconds:.0f} s" if np.isfinite(seconds) else "silent"
    return f"{since}: check its cable and its program"


def _advise(own_advice: str, health: CameraHealth | None, is_placed: bool) -> str:
    """The worst fault of a camera; the rig, which may place it, arrives before the server's next status."""
    if health is None:
        return own_advice
    reasons = {
        "not calibrated": not (health.calibrated or is_placed),
        "moved: excluded until it is recalibrated": health.excluded,
        "repeats an old image: excluded until it delivers new ones": health.frozen,
        "its stamps may have jumped: robots in motion will show it": health.clock == "uncertain",
        f"its stamps are corrected by {health.clock_correction_ms:.1f} ms: check its clock": health.clock
        == "corrected",
        "two nodes use this name": health.duplicate_publisher,
    }
    return next((reason for reason, holds in reasons.items() if holds), own_advice)


def describe_server(state: ArenaState) -> str:
    """Return one line on the server."""
    if state.status is None or not state.server_alive:
        return "no server found yet" if state.status is None else "the server is offline"
    status: FusionStatus = state.status.message
    if state.age_s(state.status) > STALE_S:
        return f"the server is silent for {state.age_s(state.status):.0f} s"
    return (
        f"{status.frame_sets_per_s:.0f} frame sets/s, latency {_number(status.latency_ms, 1)} ms, "
        f"processor {100 * status.cpu:.0f} %, {status.memory_mb:.0f} MB"
    )


def describe_latency(state: ArenaState) -> str:
    """Return the shares of the latency's parts, the mean of all robots' latest poses.

    Shares, because the latency itself is the server's median over one second.
    """
    recent = [timed.message.latency for timed in state.poses.values() if state.age_s(timed) < STALE_S]
    latencies = [latency for latency in recent if latency is not None and latency.total_ms > 0]
    if not latencies:
        return ""
    total = sum(latency.total_ms for latency in latencies)
    parts = (
        f"{name.removesuffix('_ms')} {100 * sum(getattr(latency, name) for latency in latencies) / total:.0f} %"
        for name in Latency.__struct_fields__
        if name not in ("exposure_ms", "detect_ms", "total_ms")  # camera_ms includes the first two
    )
    return f"of the latency: {', '.join(parts)}"


def tabulate_faults(state: ArenaState) -> HtmlTable:
    """One row per reason for which the server or this viewer skipped something, and per camera where it is known."""
    status = state.status.message if state.status else None
    counts = Counter(status.faults if status else {})
    for name, health in status.cameras.items() if status else ():
        counts.subtract(health.faults)  # the remaining ones are of no known camera
        counts.update({f"{name}: {reason}": count for reason, count in health.faults.items()})
    counts.update({f"viewer: {reason}": count for reason, count in state.faults.items()})
    rows = [TableRow((reason, str(count)), "warn") for reason, count in counts.items() if count > 0]
    return HtmlTable((Column("fault"), Column("count")), rows)


def describe_arena(state: ArenaState) -> str:
    """Return the whole state in one line, for terminals and logs."""
    cameras = [
        f"{row.cells[0]} {row.cells[1]} fps{_bracketed_note(row)}" for row in tabulate_cameras(state).rows
    ]
    robots = [
        f"{row.cells[0]} {row.cells[1]} at {row.cells[2]} ±{row.cells[5]} mm{_bracketed_note(row)}"
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
    return NO_VALUE if value is None or not np.isfinite(value) else f"{value:z.{digits}f}"


def _bracketed_note(row: TableRow) -> str:
    return f" ({row.note})" if row.note else ""
