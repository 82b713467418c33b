# SPDX-License-Identifier: BSD-3-Clause
"""A recording is played with its timing, from any position, with the calibration that was in use there."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from calib.rig.recording import RecordingWriter
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.messages import encode
from fusion.commands.trim import trim
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import Robots, robots_key
from tests.waiting import in_thread, wait_for
from tests.web.arena import ArenaMessages, four_cameras
from tests.web.browser import loopback
from web.errors import WebError
from web.roundel.serve_page import ViewArena
from web.state.feed import Feed
from web.state.recording_player import RecordingPlayer
from web.tables import tabulate_robots
from web.tabs.record_tab import ReplayControls
from web.view import View

HZ, SECONDS = 10, 20
ROBOTS = Robots(robots={"rover": Robot(diameter_m=0.09)})
START_NS = 1_700_000_000 * 10**9


class RecordedArena(ArenaMessages):
    """Writes the messages to a recording at the time `now_s`."""

    def __init__(self, writer: RecordingWriter) -> None:
        self.writer, self.now_s = writer, 0.0

    def put(self, key: str, data: bytes) -> None:
        self.writer.put(key, data, START_NS + round(self.now_s * 1e9))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A robot that drives along x at 1 m/s for 20 s; a rig at the start, and after 10 s one with three cameras."""
    path = tmp_path / "arena.mcap"
    with RecordingWriter(path) as writer:
        arena, rig = RecordedArena(writer), four_cameras()
        arena.rig(rig)
        arena.put(robots_key("test"), encode(ROBOTS))
        for k in range(HZ * SECONDS + 1):
            arena.now_s = k / HZ
            arena.pose("rover", (arena.now_s, 0.0, 0.0))
            if k % HZ == 0:
                arena.status()
            if arena.now_s == 10.0:
                arena.rig(type(rig)(cameras={n: c for n, c in rig.cameras.items() if n != "west"}))
    return path


@contextmanager
def playing(recording: Path) -> Iterator[tuple[RecordingPlayer, Feed]]:
    player, stop = RecordingPlayer(recording), threading.Event()
    feed = Feed(player.arena, clock=player.seconds)
    with in_thread(partial(player.run, feed, stop), stop.set):
        yield player, feed


def position(feed: Feed) -> float:
    """The robot's x, m, which equals the time of its pose in the recording, s."""
    poses = feed.state().poses
    return poses["rover"].message.position[0] if poses else -1.0


def test_a_recording_plays_at_its_own_speed_or_faster(recording: Path):
    """The feed is never ahead of the clock."""
    with playing(recording) as (player, feed):
        assert (player.arena, round(player.duration_s, 6)) == ("test", SECONDS)
        player.set_speed(8.0)
        wait_for(lambda: position(feed) >= 2.0)
        assert position(feed) <= player.seconds() < SECONDS
        wait_for(lambda: position(feed) == SECONDS)
        assert not player.playing
        assert player.seconds() == player.duration_s
        player.play()  # from the beginning
        wait_for(lambda: 0.0 <= position(feed) < SECONDS)


@pytest.mark.parametrize(("seconds", "calibrated"), [(15.0, 3), (5.0, 4), (0.0, 4), (99.0, 3)])
def test_a_jump_restores_the_state(recording: Path, seconds: float, calibrated: int):
    """While paused: the latest pose, rig and robots at that position, and no message becomes too old."""
    with playing(recording) as (player, feed):
        player.play(False)
        player.seek(12.0)
        wait_for(lambda: position(feed) == 12.0)
        player.seek(seconds)
        wait_for(lambda: position(feed) == min(seconds, SECONDS) and feed.state().rig)
        state = feed.state()
        assert state.rig is not None
        assert len(state.rig.placed()) == calibrated
        assert state.now_s == feed.state().now_s == min(seconds, player.duration_s)
        assert tabulate_robots(state).rows[0].cells[1] == "tracked"
        assert state.declared == ROBOTS.robots
        assert state.server_alive
        assert not state.faults


def test_a_truncated_recording_plays_to_its_end(recording: Path, tmp_path: Path):
    """And counts a fault."""
    short = tmp_path / "short.mcap"
    short.write_bytes(recording.read_bytes()[: recording.stat().st_size // 2])
    with playing(short) as (player, feed):
        player.play(False)
        player.seek(SECONDS)
        wait_for(lambda: position(feed) > 0)
        assert 1 < player.duration_s < SECONDS
        assert list(feed.state().faults.values()) == [1]


def test_other_keys_in_a_recording_are_ignored(tmp_path: Path):
    """Keys that the feed does not decode, and text that is not a Zenoh key."""
    path = tmp_path / "mixed.mcap"
    with RecordingWriter(path) as writer:
        arena = RecordedArena(writer)
        for key in ("weather", "", "test//pose", "test/robot/a/b/pose", "test/camera/north/#"):
            arena.put(key, b"other data")
        arena.pose("rover", (0.5, 0.0, 0.0))
    with playing(path) as (_, feed):
        wait_for(lambda: position(feed) == 0.5)
        assert not feed.state().faults


def test_without_a_page_it_ends_with_the_recording(tmp_path: Path, capsys: pytest.CaptureFixture):
    """It prints one line per second; the last one shows the end of the recording."""
    with RecordingWriter(tmp_path / "short.mcap") as writer:
        RecordedArena(writer).pose("rover", (0.5, 0.0, 0.0))
    ViewArena(headless=True).show_recording(tmp_path / "short.mcap", threading.Event())
    assert "rover tracked at +0.50 +0.00 +0.00" in capsys.readouterr().out.splitlines()[-1]


def test_an_invalid_recording_is_an_error(tmp_path: Path):
    """The message names the file: a missing one, one that is not MCAP, and one without an arena."""
    with pytest.raises(ConfigError, match=r"none\.mcap"):
        RecordingPlayer(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("not a recording")
    with pytest.raises(ConfigError, match=r"text\.mcap"):
        RecordingPlayer(tmp_path / "text.mcap")
    with RecordingWriter(tmp_path / "other.mcap") as writer:
        writer.put("weather", b"rain", START_NS)
    with pytest.raises(ConfigError, match=r"other\.mcap.*roundel record"):
        RecordingPlayer(tmp_path / "other.mcap")


def test_the_controls_follow_the_recording(recording: Path):
    """The slider shows the position, the button its action."""
    with playing(recording) as (player, feed):
        view = View(feed, loopback())
        controls = ReplayControls(view.server.gui, player)
        view.add(controls)
        player.play(False)
        player.seek(7.5)
        wait_for(lambda: position(feed) == 7.5)
        view.update()
        assert controls._position.value == 7.5
        assert controls._button.label == "Play"
        assert player.seconds() == 7.5, "an update of the page is not a jump"
        view.close()


def test_only_the_selected_part_is_played(recording: Path):
    """The position stays in it; playing at its end starts at its beginning."""
    player = RecordingPlayer(recording)
    player.play(False)
    player.select_part(12.0, 15.0)
    assert player.seconds() == 12.0
    player.seek(3.0)
    assert player.seconds() == 12.0
    player.seek(19.0)
    assert player.seconds() == 15.0
    assert not player.playing
    player.play()
    assert 12.0 <= player.seconds() < 15.0
    assert player.playing
    player.select_part(-5.0, 99.0)
    assert player.part_s == (0.0, player.duration_s)


def test_a_part_is_saved_as_a_recording(recording: Path):
    """By the page, which runs `fusion trim`: with the rig that held at its start, and the poses of the part only."""
    view = View(Feed("test"), loopback())
    player = RecordingPlayer(recording)
    controls = ReplayControls(view.server.gui, player)
    player.select_part(12.0, 15.0)
    text = controls.save_part()
    part = recording.with_name("arena_12.0-15.0s.mcap")
    assert str(part) in text
    assert RecordingPlayer(part).duration_s == pytest.approx(3.0)
    with playing(part) as (_, feed):
        wait_for(lambda: position(feed) >= 12.0)
        rig = feed.state().rig
        assert rig is not None
        assert "west" not in rig.cameras
    with pytest.raises(WebError, match="exists"):
        controls.save_part()
    view.close()


@pytest.mark.parametrize(
    ("from_s", "to_s", "says"), [(3.0, 3.0, "empty"), (-1.0, 3.0, "begins at 0"), (30.0, 40.0, "no message")]
)
def test_an_empty_part_is_refused(recording: Path, from_s: float, to_s: float, says: str):
    """And nothing is written."""
    out = recording.with_name("part.mcap")
    with pytest.raises(ConfigError, match=says):
        trim(recording, out, from_s=from_s, to_s=to_s)
    assert not out.exists()
