# SPDX-License-Identifier: BSD-3-Clause
"""The tab Status: figures of the server over the last minute, what happened, and how a program reads the poses."""

import html
import time
from collections import deque
from dataclasses import dataclass, field

import numpy as np
import viser
from viser import uplot

from camera_node.foundation.arrays import Array
from fusion.protocol.pose_messages import FusionStatus
from web.condition import Condition, assess
from web.html_tables import COLOURS, MARGIN_PX, small
from web.state.feed import ArenaState
from web.tables import describe_latency, describe_server, tabulate_faults
from web.widgets import set_content, set_property

PLOT_PX = 110
LENGTH_S = 60
PLOTS = ("latency, ms", "poses per second", "residual, px")
NO_DATA = (np.array([-LENGTH_S, 0.0]), np.array([np.nan, np.nan]))
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


class StatusTab:
    """Figures of the server, plots, the log, skipped messages, and a program to copy.

    Args:
        gui: where the controls are added.
        endpoint: where programs reach the server; empty for a recording.
        arena: the arena's name.
    """

    def __init__(self, gui: viser.GuiApi, endpoint: str, arena: str) -> None:
        self._endpoint = endpoint
        self._history, self._log = FigureHistory(), EventLog()
        self._server = gui.add_html("")
        self._latency = gui.add_html("")
        self._plots = [_add_plot(gui, title) for title in PLOTS]
        with gui.add_folder("Log"):
            self._events = gui.add_html(small("nothing yet"))
        self._fault_folder = gui.add_folder("Skipped messages", visible=False)
        with self._fault_folder:
            self._faults = gui.add_html("")
        if endpoint:
            with gui.add_folder("Poses for your program", expand_by_default=False):
                gui.add_html(snippet(endpoint, arena))

    def update(self, state: ArenaState) -> None:
        """Show the state."""
        set_content(self._server, small(describe_server(state)))
        set_content(self._latency, small(describe_latency(state)))
        faults = tabulate_faults(state)
        set_property(self._fault_folder, "visible", bool(faults.rows))
        set_content(self._faults, faults.html())
        if self._log.add(assess(state, self._endpoint)):
            set_content(self._events, "".join(map(_event_html, self._log.events)))
        if self._history.add(state):
            seconds, *figures = self._history.columns(state.now_s)
            for plot, values in zip(self._plots, figures, strict=True):
                plot.data = (seconds, values) if len(seconds) > 1 else NO_DATA


def _add_plot(gui: viser.GuiApi, title: str) -> viser.GuiUplotHandle:
    """A plot of the last minute, which ends now at 0 s."""
    x: Array = NO_DATA[0]
    return gui.add_uplot(
        (x, NO_DATA[1]),
        (uplot.Series(label="s"), uplot.Series(label=title, stroke=COLOURS["ok"], width=1.5)),
        title=title,
        scales={"x": uplot.Scale(time=False, range=(-LENGTH_S, 0.0))},
        legend=uplot.Legend(show=False),
        height=PLOT_PX,
    )


def _event_html(event: Event) -> str:
    return small(f"{event.time_of_day}  {event.condition.text}", event.condition.level)


def snippet(endpoint: str, arena: str) -> str:
    """Where poses are published, and a program that prints them; a click selects it."""
    program = f"""from roundel import Arena

with Arena.connect("{endpoint}", arena="{arena}") as arena:
    for pose in arena.poses():
        print(pose.t_ns, pose.robot, pose.position, pose.quaternion_wxyz)"""
    style = (
        f"margin:4px {MARGIN_PX}px;font-size:11px;line-height:1.4;overflow-x:auto;padding:8px;background:#0006;"
        "user-select:all;white-space:pre"
    )
    key = small(f"Zenoh key {arena}/robot/NAME/pose at {endpoint}, MessagePack: see docs/messages.md")
    return f'{key}<pre style="{style}">{html.escape(program)}</pre>'
