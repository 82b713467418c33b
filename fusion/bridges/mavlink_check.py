# SPDX-License-Identifier: BSD-3-Clause
"""Compares an autopilot's own estimates with the poses that it was sent: frames, yaw and delay.

The autopilot streams LOCAL_POSITION_NED and ATTITUDE. Its positions a are those that it was sent, p, some time earlier,
in a frame that may be turned about the vertical, mirrored (z up in place of z down) and displaced:
a(t) = Rz(angle) M p(t - delay) + offset, by least squares over all four. The time t is the autopilot's own, on the
server's clock by the message that took least time to arrive.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from camera_node.foundation.arrays import Array
from fusion.bridges.mavlink_frames import DOWN, FrdPose, roll_pitch_yaw

DELAYS_S = np.arange(-0.1, 1.0, 0.005)  # a negative one: the autopilot extrapolates
MIN_SPREAD_M = 0.1  # standard deviation of the positions from which directions show
MAX_OFF = 0.2  # share of the spread that a fit may leave
MAX_ANGLE = np.radians(10.0)  # an autopilot refuses or drifts with more
MAX_DELAY_S = 0.1  # an estimator of PX4 or ArduPilot buffers so much
MAX_SAMPLES = 20_000


@dataclass(frozen=True)
class AutopilotAlignment:
    """How the autopilot's positions follow from those that it was sent; see the module.

    Attributes:
        delay_s, angle, offset, is_mirrored: of the model.
        rms_m: of what it leaves.
        spread_m: standard deviation of the positions.
    """

    delay_s: float
    angle: float
    offset: Array
    is_mirrored: bool
    rms_m: float
    spread_m: float

    @property
    def is_determined(self) -> bool:
        """Whether the vehicle moved, and the model explains how."""
        return self.spread_m >= MIN_SPREAD_M and self.rms_m <= MAX_OFF * self.spread_m


def align(sent: Array, estimated: Array) -> AutopilotAlignment | None:
    """Fit the model to rows (N, 4) and (M, 4) of time (s) and position (m); None where they do not overlap."""
    best: AutopilotAlignment | None = None
    for delay_s in DELAYS_S.tolist():
        at = estimated[:, 0] - delay_s
        rows = (at >= sent[0, 0]) & (at <= sent[-1, 0])
        if rows.sum() < len(estimated) // 2 or rows.sum() < 2:
            continue
        p = np.column_stack([np.interp(at[rows], sent[:, 0], column) for column in sent.T[1:]])
        for is_mirrored in (False, True):
            found = _fit(p @ DOWN if is_mirrored else p, estimated[rows, 1:])
            if best is None or found[2] < best.rms_m:
                spread = float(np.sqrt(p.var(0).sum()))
                best = AutopilotAlignment(delay_s, found[0], found[1], is_mirrored, found[2], spread)
    return best


def _fit(p: Array, a: Array) -> tuple[float, Array, float]:
    """The angle about z, the offset, and the RMS rest of a = Rz(angle) p + offset."""
    q, b = p - p.mean(0), a - a.mean(0)
    sine, cosine = q[:, 0] @ b[:, 1] - q[:, 1] @ b[:, 0], q[:, 0] @ b[:, 0] + q[:, 1] @ b[:, 1]
    angle = float(np.arctan2(sine, cosine))
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    rest = b - q @ R.T
    return angle, a.mean(0) - R @ p.mean(0), float(np.sqrt((rest**2).sum(1).mean()))


@dataclass
class AutopilotCheck:
    """Collects what is sent and what the autopilot estimates; times are the server's, seconds."""

    heartbeats: int = 0
    _sent: deque[tuple[float, ...]] = field(default_factory=lambda: deque(maxlen=MAX_SAMPLES))
    _positions: deque[tuple[float, ...]] = field(default_factory=lambda: deque(maxlen=MAX_SAMPLES))
    _yaws: deque[tuple[float, ...]] = field(default_factory=lambda: deque(maxlen=MAX_SAMPLES))

    def add_sent(self, t_ns: int, pose: FrdPose) -> None:
        """Note a pose that was sent."""
        self._sent.append((t_ns * 1e-9, *pose.position.tolist(), roll_pitch_yaw(pose.rotation)[2]))

    def add_message(self, now_ns: int, message: object) -> None:
        """Note a message of the autopilot that arrived now; kinds that say nothing here are ignored."""
        kind, now_s = getattr(message, "get_type", str)(), now_ns * 1e-9
        if kind == "HEARTBEAT":
            self.heartbeats += 1
        elif kind == "LOCAL_POSITION_NED":
            self._positions.append((now_s, *_read(message, "time_boot_ms", "x", "y", "z")))
        elif kind == "ATTITUDE":
            self._yaws.append((now_s, *_read(message, "time_boot_ms", "yaw")))

    def lines(self) -> Iterator[tuple[bool, str]]:
        """What was found, each with whether it is in order; at least one line."""
        if not self._sent:
            yield False, "no pose was sent: the robot was not tracked"
            return
        if not (self.heartbeats or self._positions or self._yaws):
            yield False, "nothing arrived from the autopilot: check --to, and that it sends to this port"
            return
        sent = np.array(self._sent)
        found = align(sent[:, :4], _timed(self._positions)) if self._positions else None
        if found is None:
            yield (
                False,
                "no LOCAL_POSITION_NED arrived: the autopilot has no position, or does not stream it here",
            )
        elif not found.is_determined:
            yield False, _undetermined(found)
        else:
            yield from _describe(found)
        yield self._yaw_line(sent, 0.0 if found is None or not found.is_determined else found.delay_s)

    def _yaw_line(self, sent: Array, delay_s: float) -> tuple[bool, str]:
        if not self._yaws:
            return False, "no ATTITUDE arrived: the yaw was not compared"
        t_s, yaw = _timed(self._yaws).T
        expected = np.interp(t_s - delay_s, sent[:, 0], np.unwrap(sent[:, 4]))
        off = float(np.angle(np.exp(1j * (yaw - expected)).mean()))
        state = f"yaw differs by {np.degrees(off):+.0f} degrees"
        if abs(off) <= MAX_ANGLE:
            return True, state
        return False, f"{state}: set --forward-deg to the direction of the nose in the robot's body"


def _read(message: object, *names: str) -> list[float]:
    return [float(getattr(message, name)) for name in names]


def _timed(rows: Sequence[tuple[float, ...]]) -> Array:
    """Rows of time (s, the server's) and values, from rows of arrival (s), the autopilot's time (ms) and values."""
    table = np.array(rows)
    boot_s = 1e-3 * table[:, 1]
    return np.column_stack([boot_s + (table[:, 0] - boot_s).min(), table[:, 2:]])


def _undetermined(found: AutopilotAlignment) -> str:
    if found.spread_m < MIN_SPREAD_M:
        return "the vehicle hardly moved: carry it about by half a metre in all directions, and turn it"
    off = f"{found.rms_m:.2f} m RMS of {found.spread_m:.2f} m of motion"
    remedy = "its estimator does not use them; PX4 needs EKF2_EV_CTRL, ArduPilot VISO_TYPE and EK3_SRC1_*"
    return f"the autopilot's positions do not follow those that it is sent ({off}): {remedy}"


def _describe(found: AutopilotAlignment) -> Iterator[tuple[bool, str]]:
    if found.is_mirrored:
        yield False, "z points up in the autopilot's positions and down in those that it is sent"
    degrees = np.degrees(found.angle)
    is_aligned = abs(found.angle) <= MAX_ANGLE
    remedy = "" if is_aligned else f": its x axis is not that of --heading-deg; add {degrees:+.0f} to it"
    yield is_aligned, f"frames differ by {degrees:+.0f} degrees about the vertical{remedy}"
    is_prompt = found.delay_s <= MAX_DELAY_S
    remedy = "" if is_prompt else ": reduce it, or set EKF2_EV_DELAY or VISO_DELAY_MS to it"
    yield is_prompt, f"its positions are {1e3 * found.delay_s:.0f} ms behind those that it is sent{remedy}"
    x, y, z = found.offset
    yield True, f"offset {x:+.2f}, {y:+.2f}, {z:+.2f} m; {1e3 * found.rms_m:.0f} mm RMS of what is left"
