# SPDX-License-Identifier: BSD-3-Clause
"""The tab Calibrate: the versions of the rig, of which any can be restored by undo and redo; and how the page changes
it: it is written to the rig's file, and in force on the server."""

from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import viser

from calib.live.rig_requests import set_rig
from calib.rig.rig import Rig, save_rig
from calib.rig.rig_messages import RigHistory, RigVersion, holds_rig
from calib.wand.nominal_lens import load_known_lenses
from camera_node.foundation.config import load_yaml
from camera_node.foundation.errors import RoundelError, printable
from camera_node.geometry.body import PrintedWand
from fusion.protocol.arena_health import assess_calibration, calibration_problems, describe_calibration
from web.html_tables import Column, HtmlTable, TableRow, small
from web.state.feed import ArenaState
from web.state.subscription import Subscription
from web.tables import NO_VALUE
from web.widgets import MAX_LABEL, ActionButton, Answer, set_content

HISTORY_COLUMNS = (
    Column("made", "", "when the rig was calibrated or changed"),
    Column("by", "", "the program that changed the rig, by its own account"),
    Column("state", "", "undo restores the rig below the one in force, redo the one above"),
    Column("file", "", "on the server; none if a restart loses it"),
)
UNDO, REDO = "Undo the last change", "Redo"
LEVELS = {"earlier": "wait", "in force": "ok", "undone": "warn"}


def calibration_in_force(state: ArenaState) -> str:
    """One line on the calibration that the server uses: its grade, age and expected error, and what needs attention."""
    problems = calibration_problems(assess_calibration(state.rig, datetime.now(UTC)))
    return small(describe_rig(state.rig), "warn" if problems else "ok")


def describe_rig(rig: Rig | None) -> str:
    """Such as "calibration of grade B, 2 days old; 4 of 4 cameras placed; expected error 0.8 mm, at most 1.9 mm".

    The rig comes from the network: its `calibration` holds anything.
    """
    assessed = assess_calibration(rig, datetime.now(UTC))
    if rig is None or not assessed.placed:
        return "not calibrated yet"
    parts = [describe_calibration(assessed), f"{assessed.placed} of {len(rig.cameras)} cameras placed"]
    expected = rig.calibration.get("expected_mm")
    figures = [expected.get(key) for key in ("median", "worst")] if isinstance(expected, dict) else []
    if figures and all(isinstance(figure, int | float) for figure in figures):
        parts.append(f"expected error {figures[0]:.1f} mm, at most {figures[1]:.1f} mm")
    return "; ".join([*parts, *calibration_problems(assessed)])


class RigHistoryPanel:
    """Lists the versions of the server's rig; undoes and redoes changes. `roundel history` prints the same."""

    def __init__(self, gui: viser.GuiApi, subscription: Subscription) -> None:
        self._shown: RigHistory | None = None
        with gui.add_folder("History of the calibration"):
            self._table = gui.add_html(tabulate_history(None).html())
            answer = Answer(gui)
            self._undo = ActionButton(gui, UNDO, partial(subscription.step_rig, "undo"), answer)
            self._redo = ActionButton(gui, REDO, partial(subscription.step_rig, "redo"), answer)

    def update(self, state: ArenaState) -> None:
        """Enable the buttons while there is something to restore."""
        if state.history is not self._shown:
            self._shown = state.history
            set_content(self._table, tabulate_history(state.history).html())
        history = state.history or RigHistory()
        for button, label, version in (
            (self._undo, UNDO, history.subject("undo")),
            (self._redo, REDO, history.subject("redo")),
        ):
            what = f": {printable(version.change, MAX_LABEL)}" if version and version.change else ""
            button.show(enabled=state.server_alive and version is not None, label=label + what)


def tabulate_history(history: RigHistory | None) -> HtmlTable:
    """One row for each version of the rig, newest first."""
    rows = [_row(version) for version in reversed(history.versions)] if history is not None else []
    return HtmlTable(HISTORY_COLUMNS, rows, "no calibration yet")


def _row(version: RigVersion) -> TableRow:
    made = datetime.fromtimestamp(version.t_ns / 1e9).strftime("%Y-%m-%d %H:%M")
    program = printable(version.source.program, 32) if version.source else version.unnamed_maker
    cells = (made, program, version.state, printable(version.file, 32) or NO_VALUE)
    return TableRow(cells, LEVELS[version.state], printable(version.change, 120))


@dataclass(frozen=True)
class CalibrationFiles:
    """The rig, whose intrinsics are read and whose extrinsics are written, and the wand."""

    rig: Path
    wand: Path

    @property
    def candidate(self) -> Path:
        """The rig that is calibrated but not accepted yet, beside the rig."""
        return self.rig.with_name(f"{self.rig.stem}.candidate.yaml")

    def check(self) -> None:
        """Raise ConfigError or CalibrationError if a file is missing or invalid."""
        load_known_lenses(self.rig)
        load_yaml(self.wand, PrintedWand)


def current_rig(subscription: Subscription, files: CalibrationFiles) -> Rig:
    """The rig in force on the server; without one that of the file, or a rig without cameras.

    Raises:
        CalibrationError, ConfigError: the file is invalid.
    """
    in_force = subscription.feed.state().rig
    return in_force if in_force is not None else load_known_lenses(files.rig)


def apply_rig(subscription: Subscription, files: CalibrationFiles, rig: Rig) -> str:
    """Have the server use a rig, and write it; returns the outcome as text.

    The server is asked first: it may save its rig in the same file, which then is one step of the history.

    Raises:
        CalibrationError, ConfigError: the file can't be written.
    """
    outcome = "in force on the server"
    try:
        set_rig(subscription.session, subscription.feed.keys.arena, rig, "web")
    except RoundelError as error:
        outcome = f"{files.rig} is written, but not in force: {error}"
    if not holds_rig(files.rig, rig):
        save_rig(rig, files.rig)
    return outcome
