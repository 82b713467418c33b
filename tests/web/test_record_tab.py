# SPDX-License-Identifier: BSD-3-Clause
"""The tabs Record and Status: record, list, replay in the page and export, by clicks, with a real server."""

import math
import re
import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

import pytest
from playwright.sync_api import Locator

from camera_node.foundation.errors import ConfigError
from camera_node.protocol.server_connection import ServerConnection
from fusion.commands.recordings import recordings
from fusion.recordings.recording_files import list_recordings
from tests.conftest import ROOT
from tests.fusion.unknown_robot import serving_an_unknown_robot
from tests.waiting import wait_for
from tests.web.arena import LiveArena
from tests.web.browser import browsing, drawing, loopback, set_checkbox, value_of
from web.condition import Condition
from web.html_tables import HtmlTable
from web.page import add_live_page
from web.state.feed import Feed
from web.state.subscription import Subscription
from web.tabs.record_tab import tabulate_recordings
from web.tabs.status_tab import LENGTH_S, EventLog, FigureHistory
from web.view import View

EXPORT_MS = 120_000  # on a busy machine: a process starts and fuses the recording


@pytest.fixture
def view(tmp_path: Path) -> Iterator[View]:
    """The page of a running arena."""
    with serving_an_unknown_robot(tmp_path) as (endpoint, _), ServerConnection([endpoint]) as connection:
        subscription = Subscription(connection, Feed("test"))
        view = View(subscription.feed, loopback())
        with ExitStack() as closing, drawing(view):
            add_live_page(view, subscription, endpoint, None, closing, tmp_path / "recordings")
            yield view
        subscription.close()


def middle_left_of(thumb: Locator, by_px: float = 60.0) -> tuple[float, float]:
    """A point left of the middle of an element."""
    box = thumb.bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2 - by_px, box["y"] + box["height"] / 2


def test_a_recording_is_made_shown_exported_renamed_and_deleted(view: View, tmp_path: Path):
    """Its messages are counted; the page shows it in the place of the arena, and the arena again."""
    folder = tmp_path / "recordings"
    with browsing(view) as page:
        page.get_by_role("tab", name="Record").click()
        page.get_by_text("no recording in this folder yet").wait_for()
        page.get_by_role("button", name="Start recording").click()
        page.wait_for_function("/mcap: [1-9][0-9]{2,} messages/.test(document.body.innerText)")
        page.get_by_role("button", name="Stop recording").click()
        page.get_by_text("recorded").first.wait_for()
        (summary,) = wait_for(lambda: list_recordings(folder))
        assert summary.seconds is not None
        assert summary.seconds > 0
        assert len(summary.cameras) == 4
        page.get_by_role("cell", name=summary.path.name).wait_for()
        page.get_by_role("button", name="Replay").click()
        page.get_by_text(f"recording {summary.path.name}:").wait_for()
        set_checkbox(page, view, "Loop")
        page.get_by_role("button", name="Pause").click()
        page.get_by_role("button", name="Step").click()
        page.get_by_role("button", name="Play", exact=True).wait_for()
        assert view.shown is not view.feed
        end = page.locator(".multi-slider-thumb").last  # of the part
        end.hover()
        page.mouse.down()
        page.mouse.move(*middle_left_of(end))
        page.mouse.up()
        save = page.get_by_role("button", name="Save the part as a recording")
        wait_for(save.is_enabled)
        save.click()
        page.get_by_text(f"wrote {summary.path.with_suffix('')}_0.0-").wait_for(timeout=EXPORT_MS)
        page.get_by_role("button", name="Back to the arena").click()
        page.get_by_text("the page shows the arena").wait_for()
        assert view.shown is view.feed
        page.get_by_role("button", name="Export poses").click()
        page.get_by_text(f"wrote {summary.path.with_suffix('.csv')}").wait_for(timeout=EXPORT_MS)
        page.locator("xpath=//*[text()='New file name']/following::input[1]").fill("tuesday")
        wait_for(lambda: value_of(view, "New file name") == "tuesday")
        selected = value_of(view, "Recording")
        page.get_by_role("button", name="Rename the recording").click()
        page.get_by_text(f"{selected} is called tuesday.mcap").wait_for()
        assert (folder / "tuesday.mcap").exists()
        wait_for(lambda: value_of(view, "Recording") != selected)
        deleted = folder / value_of(view, "Recording")
        page.get_by_role("button", name="Delete the recording").click()
        page.get_by_text(f"click again to delete {deleted.name}").wait_for()
        page.get_by_role("button", name="Delete: click again").click()
        page.get_by_text(f"{deleted.name} is deleted").wait_for()
        assert not deleted.exists()
    assert len(list_recordings(folder)) == 1
    assert summary.path.with_suffix(".csv").read_text().startswith("t_ns,robot,x,y,z")


def test_a_file_that_vanishes_hides_no_other(tmp_path: Path):
    """A recording that is removed while the folder is read, like a link to nothing, can't be examined."""
    shutil.copy(ROOT / "configs" / "sample" / "recording.mcap", tmp_path / "monday.mcap")
    (tmp_path / "gone.mcap").symlink_to(tmp_path / "nothing")
    assert [summary.path.name for summary in list_recordings(tmp_path)] == ["monday.mcap"]


def test_recordings_are_listed_renamed_and_removed(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A name that is taken, a path in the place of a name and a file that is no recording are refused."""
    for name in ("monday.mcap", "sunday.mcap", "rig.yaml"):
        shutil.copy(ROOT / "configs" / "sample" / "recording.mcap", tmp_path / name)
    monday = str(tmp_path / "monday.mcap")
    recordings("list", (str(tmp_path),))
    assert re.search(
        r"^monday\.mcap: \d+\.\d s, .* 4 cameras, robots drone", capsys.readouterr().out, re.MULTILINE
    )
    refused: tuple[tuple[Literal["list", "rename", "remove"], tuple[str, ...], str], ...] = (
        ("rename", (monday, "sunday"), "exists"),
        ("rename", (monday, "../tuesday"), "a recording"),
        ("rename", (monday,), "FILE NAME"),
        ("remove", (str(tmp_path / "rig.yaml"),), "no recording"),
        ("remove", (str(tmp_path / "tuesday.mcap"),), "does not exist"),
        ("list", (monday,), "not a folder"),
    )
    for action, words, fault in refused:
        with pytest.raises(ConfigError, match=fault):
            recordings(action, words)
    recordings("rename", (monday, "tuesday.mcap"))
    recordings("remove", (str(tmp_path / "sunday.mcap"),))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rig.yaml", "tuesday.mcap"]


def test_a_file_without_an_index_is_listed(tmp_path: Path):
    """It is being written, was cut off, or is no recording at all."""
    (tmp_path / "x.mcap").write_bytes(b"\x89MCAP0\r\n cut")
    (summary,) = list_recordings(tmp_path)
    assert (summary.seconds, summary.cameras) == (None, ())
    table: HtmlTable = tabulate_recordings([summary])
    assert table.rows[0].level == "warn"
    assert list_recordings(tmp_path / "absent") == []


def test_the_log_has_one_line_for_each_change():
    """Changing figures are no change; a return to normal is one."""
    log = EventLog()
    for seconds in range(3, 8):
        log.add(Condition("bad", f"camera north silent for {seconds} s"))
    log.add(Condition("ok", "4 cameras"))
    log.add(Condition("ok", "3 cameras, 9 poses/s"))
    assert [event.condition.level for event in log.events] == ["ok", "bad"]
    for k in range(200):
        log.add(Condition("warn", "a" * k))
    assert len(log.events) == 50


def test_the_history_has_each_status_once_and_the_last_minute_only(arena: LiveArena, feed: Feed):
    history = FigureHistory()
    arena.status()
    wait_for(lambda: feed.state().status)
    state = feed.state()
    assert history.add(state)
    assert not history.add(state)
    seconds, latency, rate, residual = history.columns(state.now_s)
    assert -LENGTH_S < seconds[0] <= 0
    assert (latency[0], rate[0]) == (7.7, 30.0)
    assert math.isclose(residual[0], 0.08)
    assert len(history.columns(state.now_s + LENGTH_S + 1)[0]) == 0
