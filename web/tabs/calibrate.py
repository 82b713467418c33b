# SPDX-License-Identifier: BSD-3-Clause
"""The tab Calibrate: changes of the rig in force, which can be undone."""

from datetime import datetime

import numpy as np
import viser

from calib.rig.camera import Camera
from calib.rig.messages import RigMessage
from calib.rig.rig import Rig
from camera_node.text import printable
from web.feed import ArenaState
from web.html_tables import Column, HtmlTable, TableRow
from web.subscription import Subscription
from web.widgets import ActionButton, Answer, set_content

MOVED_MM = 0.05  # a smaller motion of a camera is none
MAX_NAMED = 3  # cameras whose motion is named
HISTORY_COLUMNS = (
    Column("in force since"),
    Column("by", "", "the program that changed the rig, by its own account"),
    Column("change", "", "motion of cameras since the rig before"),
)


class RigHistory:
    """Lists the changes of the rig since the page was started; undoes and redoes them."""

    def __init__(self, gui: viser.GuiApi, subscription: Subscription) -> None:
        self._shown: tuple[RigMessage, ...] | None = None
        with gui.add_folder("Changes of the rig"):
            self._table = gui.add_html("")
            answer = Answer(gui)
            self._buttons = (
                ActionButton(gui, "Undo the last change", subscription.undo, answer),
                ActionButton(gui, "Redo", subscription.redo, answer),
            )

    def update(self, state: ArenaState) -> None:
        """Enable the buttons while there is a server."""
        if state.rigs is not self._shown:
            self._shown = state.rigs
            set_content(self._table, tabulate_rigs(state.rigs).html())
        for button in self._buttons:
            button.show(enabled=state.server_alive)


def tabulate_rigs(rigs: tuple[RigMessage, ...]) -> HtmlTable:
    """One row for each rig that was in force, newest first, with the difference from the one before."""
    rows = []
    for k in reversed(range(len(rigs))):
        message, before = rigs[k], rigs[k - 1].rig if k else None
        since = datetime.fromtimestamp(message.t_ns / 1e9).strftime("%m-%d %H:%M:%S")
        program = printable(message.source.program, 32) if message.source else "the server"
        cells = (since, program, describe_change(before, message.rig))
        rows.append(TableRow(cells, "ok" if k == len(rigs) - 1 else "wait"))
    return HtmlTable(HISTORY_COLUMNS, rows, "no rig yet")


def describe_change(before: Rig | None, after: Rig) -> str:
    """What changed from one rig to the next: cameras that were added, removed or moved."""
    new, old = after.placed(), before.placed() if before is not None else {}
    if before is None:
        return f"{len(new)} cameras placed"
    moved = {name: _moved_mm(old[name], new[name]) for name in new.keys() & old.keys()}
    moved = {name: mm for name, mm in sorted(moved.items(), key=lambda m: -m[1]) if mm > MOVED_MM}
    parts = [f"{name} {mm:.1f} mm" for name, mm in list(moved.items())[:MAX_NAMED]]
    parts += [f"{len(moved) - MAX_NAMED} more"] if len(moved) > MAX_NAMED else []
    parts += [f"{name} placed" for name in sorted(new.keys() - old.keys())]
    parts += [f"{name} not placed" for name in sorted(old.keys() - new.keys())]
    return ", ".join(parts) or "the same poses"


def _moved_mm(old: Camera, new: Camera) -> float:
    return 1e3 * float(np.linalg.norm(new.matrix()[:3, 3] - old.matrix()[:3, 3]))
