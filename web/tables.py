# SPDX-License-Identifier: BSD-3-Clause
"""What the panel's tables and the status line say of an arena."""

import html
from dataclasses import dataclass

import numpy as np

from fusion.messages import CameraHealth, FusionStatus, Latency, RobotPose
from web.feed import Latest, Seen

STALE_S = 2.0  # a robot or a camera that was silent for so long is away
NONE = "–"
HUE_OF = {"tracked": "ok", "coasting": "warn"}  # of a robot's state; else bad
HUES = {"ok": "#40c8aa", "warn": "#f0a63a", "bad": "#ef5b5b"}


@dataclass(frozen=True)
class Table:
    """Text in rows, and how each row does: a hue of `HUES`."""

    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    hues: list[str]

    def html(self) -> str:
        """The table for the panel; whatever the network said is escaped."""
        head = "".join(f"<th>{html.escape(text)}</th>" for text in self.header)
        body = "".join(
            f'<tr style="border-top:1px solid #8883"><td>{_dot(hue)}'
            f"{'</td><td>'.join(html.escape(text) for text in row)}</td></tr>"
            for row, hue in zip(self.rows, self.hues, strict=True)
        )
        style = "width:100%;border-collapse:collapse;font-size:11px;line-height:1.8;text-align:left;white-space:nowrap"
        return f'<table style="{style}"><tr style="opacity:.6">{head}</tr>{body}</table>'


def robot_state(latest: Latest, robot: str) -> str:
    """The state that a robot's newest pose tells, or "away" when it is too old to tell one."""
    seen = latest.poses[robot]
    return "away" if latest.age(seen) > STALE_S else seen.message.state


def tabulate_robots(latest: Latest) -> Table:
    """One row a robot: state, position (m), speed (m/s) and one standard deviation of the position (mm)."""
    misfits = latest.status.message.misfits if latest.status else {}
    rows, hues = [], []
    for name, seen in sorted(latest.poses.items()):
        pose: RobotPose = seen.message
        state = robot_state(latest, name)
        place = " ".join(f"{x:+.2f}" for x in pose.position)
        speed, sigma = float(np.linalg.norm(pose.velocity)), position_sigma_mm(pose)
        misfit = misfits.get(name)
        told = f"{state}, markers off by {misfit:.1f} px" if misfit is not None else state
        rows.append((name, told, place, f"{speed:.2f}", describe_sigma(sigma), str(pose.n_markers)))
        hues.append("warn" if misfit is not None and state == "tracked" else HUE_OF.get(state, "bad"))
    return Table(("robot", "state", "x y z m", "m/s", "σ mm", "seen"), rows, hues)


def describe_sigma(sigma_mm: float) -> str:
    """Millimetres; a robot that has long been lost may be anywhere."""
    return f"{sigma_mm:.1f}" if sigma_mm < 1000 else "> 1 m"


def position_sigma_mm(pose: RobotPose) -> float:
    """Root mean square over x, y, z of the position's standard deviation, millimetres."""
    return 1e3 * float(np.sqrt(max(0.0, np.diag(pose.covariance_matrix)[3:6].mean())))


def tabulate_cameras(latest: Latest) -> Table:
    """One row a camera: what its node says of it, and what the server sees of it.

    The columns: frames a second, time to detect, roundels a frame, RMS of the reprojection, middle of the exposure
    to arrival, clock offset, frames lost (dropped at the camera / too late for the server), advice.
    """
    server = latest.status.message.cameras if latest.status else {}
    rows, hues = [], []
    for name in sorted({*latest.cameras, *server}):
        seen, health = latest.cameras.get(name), server.get(name)
        own = seen.message if seen else None
        lost = f"{own.dropped if own else 0} / {health.late if health else 0}"
        advice = _advise(latest, seen, health)
        rows.append(
            (
                name,
                _number(own and own.fps, 1),
                _number(own and own.detect_ms, 2),
                _number(own and own.roundels, 1),
                _number(health and health.residual_px, 2),
                _number(health and health.lateness_ms, 1),
                _number(own and own.clock_offset_ms, 2),
                lost,
                advice,
            )
        )
        hues.append("bad" if advice == "away" else "warn" if advice else "ok")
    header = ("camera", "fps", "detect ms", "seen", "px", "late ms", "clock ms", "lost", "")
    return Table(header, rows, hues)


def _advise(latest: Latest, seen: Seen | None, health: CameraHealth | None) -> str:
    if seen is None or latest.age(seen) > STALE_S:
        return "away"
    if health is not None and not health.calibrated:
        return "not placed"
    if health is not None and health.aside:
        return "moved: set aside until it is placed anew"
    if health is not None and health.shared:
        return "two nodes have this name"
    return seen.message.advice


def describe_server(latest: Latest) -> str:
    """One line on the server."""
    if latest.status is None or not latest.server_alive:
        return "no server answers yet" if latest.status is None else "the server is away"
    status: FusionStatus = latest.status.message
    return (
        f"{status.instants_per_s:.0f} instants/s, latency {_number(status.latency_ms, 1)} ms, "
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
    rows = [(reason, str(count)) for reason, count in counts]
    return Table(("skipped", "times"), rows, ["warn"] * len(rows))


def describe(latest: Latest) -> str:
    """All of it in one line, for terminals and logs."""
    cameras = [
        f"{row[0]} {row[1]} fps{f' ({row[-1]})' if row[-1] else ''}" for row in tabulate_cameras(latest).rows
    ]
    robots = [f"{row[0]} {row[1]} at {row[2]} ±{row[4]} mm" for row in tabulate_robots(latest).rows]
    faults = sum(int(row[1]) for row in list_faults(latest).rows)
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


def _dot(hue: str) -> str:
    return f'<span style="color:{HUES[hue]}">&#9679;</span> '
