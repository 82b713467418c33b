# SPDX-License-Identifier: BSD-3-Clause
"""The operator's guide names every control of the page with its command; a browser clicks each control in a test, and
each command runs in a test."""

import re
import shlex
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from camera_node.foundation.config import example_file
from camera_node.protocol.server_connection import ServerConnection
from tests.conftest import ROOT
from tests.web.browser import loopback
from web.page import TABS, add_live_page
from web.roundel.command import execute
from web.state.feed import Feed
from web.state.subscription import Subscription
from web.tabs.calibration_panels import CalibrationFiles
from web.view import View

ROW = re.compile(r"^\| ([^|]+) \| ([^|]+) \| ([^|]+) \|$", re.MULTILINE)
PAGE_ONLY = "in the page only"
CLICKED = tuple(sorted((ROOT / "tests" / "web").glob("test_*.py")))
WORKFLOW = ROOT / "tests" / "web" / "roundel" / "first_arena.py"
# By command: the file of the test that runs it, and what it contains.
COMMAND_TESTS = {
    "health": ("tests/fusion/diagnosis/test_health.py", '"health"'),
    "snapshot": ("tests/camera_node/node/test_preview.py", "SaveSnapshot("),
    "plan": ("tests/calib/commands/test_plan_command.py", "--rig"),
    "cameras rename": ("tests/web/roundel/test_up.py", '"cameras", "rename"'),
    "cameras forget": ("tests/web/roundel/test_up.py", '"cameras", "forget"'),
    "settings": ("tests/camera_node/node/test_preview.py", "ChangeSettings("),
    "calibrate intrinsics": ("tests/calib/commands/test_command_line.py", '"intrinsics"'),
    "calibrate apply": ("tests/fusion/server/test_rig_changes.py", '"apply"'),
    "calibrate wand": ("tests/web/roundel/test_up.py", '"--live"'),
    "calibrate world": ("tests/calib/commands/test_command_line.py", '"world"'),
    "history": ("tests/fusion/server/storage/test_active_rig.py", "history(connection"),
    "undo": ("tests/fusion/server/storage/test_active_rig.py", '"undo"'),
    "redo": ("tests/fusion/server/storage/test_active_rig.py", '"redo"'),
    "robots list": ("tests/fusion/model/test_robot_frame.py", 'robots("list"'),
    "robots rename": ("tests/fusion/model/test_robot_frame.py", 'robots("rename"'),
    "robots remove": ("tests/fusion/model/test_robot_frame.py", 'robots("remove"'),
    "robots pivot": ("tests/fusion/model/test_robot_frame.py", 'robots("pivot"'),
    "robots turn": ("tests/fusion/model/test_robot_frame.py", 'robots("turn"'),
    "robots save": ("tests/fusion/model/test_robot_frame.py", 'robots("save"'),
    "define": ("tests/fusion/client/test_define.py", '"define"'),
    "plot": ("tests/fusion/export/test_plots.py", "plot(recording)"),
    "record": ("tests/fusion/recordings/test_exact_replay.py", '"record"'),
    "recordings list": ("tests/web/test_record_tab.py", 'recordings("list"'),
    "recordings rename": ("tests/web/test_record_tab.py", 'recordings("rename"'),
    "recordings remove": ("tests/web/test_record_tab.py", 'recordings("remove"'),
    "view": ("tests/web/state/test_recording_player.py", "headless"),
    "trim": ("tests/web/state/test_recording_player.py", "trim("),
    "replay": ("tests/fusion/recordings/test_record.py", "replay(tmp_path"),
    "doctor": ("tests/fusion/diagnosis/test_health.py", '"doctor"'),
}


def rows() -> Iterator[tuple[str, str, str]]:
    """Tab, controls and command of each row of the guide."""
    text = (ROOT / "docs" / "operator.md").read_text()
    for section in text.split("\n## ")[1:]:
        tab = section.partition("\n")[0]
        for action, controls, command in ROW.findall(section):
            if action != "action" and not action.startswith("---"):
                yield tab, controls, command.strip("`")


def controls_of(page_rows: Iterator[tuple[str, str, str]]) -> set[tuple[str, str]]:
    return {(tab, name) for tab, controls, _ in page_rows for name in re.findall(r"\*([^*]+)\*", controls)}


def commands() -> set[str]:
    """The words before the first argument, of all commands."""
    words = [shlex.split(command)[1:] for _, _, command in rows() if command != PAGE_ONLY]
    two = ("cameras", "robots", "calibrate", "recordings")
    return {" ".join(each[:2] if each[0] in two else each[:1]) for each in words}


@pytest.fixture
def page_controls(tmp_path: Path) -> Iterator[set[tuple[str, str]]]:
    """Tab and label of each button and check box of the page."""
    files = CalibrationFiles(tmp_path / "rig.yaml", example_file("wand.yaml"))
    with ServerConnection(["tcp/127.0.0.1:1"]) as connection, ExitStack() as closing:
        view = View(Feed("test"), loopback())
        closing.callback(view.close)
        add_live_page(view, Subscription(connection, view.feed), "", files, closing, tmp_path)
        gui = view.server.gui
        containers = gui._container_handle_from_uuid
        found = set()
        for handle in gui._gui_input_handle_from_uuid.values():
            if type(handle).__name__ not in ("GuiButtonHandle", "GuiCheckboxHandle"):
                continue
            place: Any = containers[handle._impl.parent_container_id]
            while hasattr(place, "_impl"):  # a folder: its parent
                place = containers[place._impl.parent_container_id]
            found.add((getattr(place, "_label", "Header"), handle.label))
        yield found


def test_the_guide_names_every_control(page_controls: set[tuple[str, str]]):
    """In the section of its tab, and no other one; folders are named too."""
    named = controls_of(rows())
    folders = {"Log", "Skipped messages", "Graph"}
    assert {(tab, name) for tab, name in named if name not in folders} == page_controls
    assert {tab for tab, _, _ in rows()} == {"Header", *TABS}


def test_a_browser_clicks_every_control():
    """By its label, in a test of the page."""
    clicked = "".join(path.read_text() for path in (*CLICKED, WORKFLOW) if path != Path(__file__))
    decisions = {f"{decision} the new world" for decision in ("Accept", "Discard")}
    for tab, name in controls_of(rows()) - {("Status", "Log"), ("Status", "Skipped messages")}:
        assert f'"{name}"' in clicked or name in decisions, f"no test clicks {name} in {tab}"


def test_every_command_runs_in_a_test():
    assert commands() == set(COMMAND_TESTS)
    for command, (file, text) in COMMAND_TESTS.items():
        assert text in (ROOT / file).read_text(), f"{file} does not run {command}"


@pytest.mark.parametrize("command", sorted({command for _, _, command in rows() if command != PAGE_ONLY}))
def test_every_option_of_the_guide_exists(command: str, capsys: pytest.CaptureFixture[str]):
    words = shlex.split(command)[1:]
    subcommand = words[:2] if words[0] == "calibrate" else words[:1]
    with pytest.raises(SystemExit) as end:
        execute(*subcommand, "--help")
    assert end.value.code == 0
    printed = capsys.readouterr().out
    assert [word for word in words if word.startswith("--") and word not in printed] == []
