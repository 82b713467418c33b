# SPDX-License-Identifier: BSD-3-Clause
"""The server's figures over the last minute, and the changes of the arena's condition."""

import time
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from camera_node.foundation.arrays import Array
from fusion.protocol.pose_messages import FusionStatus
from web.condition import Condition
from web.state.feed import ArenaState

LENGTH_S = 60
MAX_EVENTS = 50


@dataclass
class FigureHistory:
    """A row for each status: arrival (s), latency (ms), poses/s and mean residual (px); NaN where unknown."""

    _rows: deque[tuple[float, float, float, float]] = field(
        default_factory=lambda: deque(maxlen=2 * LENGTH_S)
    )

    def add(self, state: ArenaState) -> bool:
        """Add the server's latest status; return whether it is new."""
        timed = state.status
        if timed is None or (self._rows and self._rows[-1][0] >= timed.received_s):
            return False
        status: FusionStatus = timed.message
        residuals = [h.residual_px for h in status.cameras.values() if h.residual_px is not None]
        residual = float(np.mean(residuals)) if residuals else np.nan
        latency = np.nan if status.latency_ms is None else status.latency_ms
        self._rows.append((timed.received_s, latency, status.frame_sets_per_s, residual))
        return True

    def columns(self, now_s: float) -> tuple[Array, Array, Array, Array]:
        """Seconds before now (at most 60, negative), latency, poses/s and residual, each (N,)."""
        rows = np.array(self._rows, float).reshape(-1, 4)
        rows = rows[rows[:, 0] > now_s - LENGTH_S]
        return rows[:, 0] - now_s, rows[:, 1], rows[:, 2], rows[:, 3]


@dataclass(frozen=True)
class Event:
    """A new condition of the arena, and the time of day."""

    time_of_day: str
    condition: Condition


class EventLog:
    """The latest changes of the condition. Texts that differ in their figures only are one event."""

    def __init__(self) -> None:
        self.events: deque[Event] = deque(maxlen=MAX_EVENTS)
        self._last = ""

    def add(self, condition: Condition) -> bool:
        """Add a condition if it is a new one; return whether it was added."""
        kind = condition.level + "".join(c for c in condition.text if not c.isdigit() and c != ".")
        kind = condition.level if condition.level == "ok" else kind
        if kind == self._last:
            return False
        self._last = kind
        self.events.appendleft(Event(time.strftime("%H:%M:%S"), condition))
        return True
