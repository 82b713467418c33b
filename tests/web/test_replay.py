# SPDX-License-Identifier: BSD-3-Clause
"""A recording is told as it was: at its pace, from any moment, with what was in force then."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from calib.rig.recording import RecordingWriter
from camera_node.errors import ConfigError
from tests.conftest import free_port
from tests.web.conftest import Said, four_cameras, wait_for
from web.__main__ import Options, replay
from web.feed import Feed
from web.playback import ReplayControls
from web.replay import RecordingPlayer
from web.tables import tabulate_robots
from web.view import View

HZ, SECONDS = 10, 20
START_NS = 1_700_000_000 * 10**9


class Recorded(Said):
    """Into a recording, at the moment `now_s` of it."""

    def __init__(self, writer: RecordingWriter) -> None:
        self.writer, self.now_s = writer, 0.0

    def put(self, key: str, data: bytes) -> None:
        self.writer.put(key, data, START_NS + round(self.now_s * 1e9))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A robot that drives along x at 1 m/s for 20 s; a rig at the start, and another with three cameras after 10 s."""
    path = tmp_path / "arena.mcap"
    with RecordingWriter(path) as writer:
        said, rig = Recorded(writer), four_cameras()
        said.rig(rig)
        for k in range(HZ * SECONDS + 1):
            said.now_s = k / HZ
            said.pose("rover", (said.now_s, 0.0, 0.0))
            if k % HZ == 0:
                said.status()
            if said.now_s == 10.0:
                said.rig(type(rig)(cameras={n: c for n, c in rig.cameras.items() if n != "west"}))
    return path


@contextmanager
def told(recording: Path) -> Iterator[tuple[RecordingPlayer, Feed]]:
    replay, stop = RecordingPlayer(recording), threading.Event()
    feed = Feed(replay.arena, clock=replay.seconds)
    thread = threading.Thread(target=replay.run, args=(feed, stop))
    thread.start()
    try:
        yield replay, feed
    finally:
        stop.set()
        thread.join()


def place(feed: Feed) -> float:
    """Where the robot is, m; by the recording that is the moment of its last pose."""
    poses = feed.latest().poses
    return poses["rover"].message.position[0] if poses else -1.0


def test_a_recording_is_told_at_its_pace_or_faster(recording: Path):
    """What is known never runs ahead of the clock, and is behind it by no more than what was not told yet."""
    with told(recording) as (replay, feed):
        assert (replay.arena, round(replay.duration_s, 6)) == ("test", SECONDS)
        replay.set_speed(8.0)
        wait_for(lambda: place(feed) >= 2.0)
        assert place(feed) <= replay.seconds() < SECONDS
        wait_for(lambda: place(feed) == SECONDS)
        assert not replay.playing
        assert replay.seconds() == replay.duration_s
        replay.play()  # anew
        wait_for(lambda: 0.0 <= place(feed) < SECONDS)


@pytest.mark.parametrize(("moment", "placed"), [(15.0, 3), (5.0, 4), (0.0, 4), (99.0, 3)])
def test_any_moment_can_be_jumped_to(recording: Path, moment: float, placed: int):
    """Paused there, everything is as it was: the last pose, the rig then in force, and nobody grows old."""
    with told(recording) as (replay, feed):
        replay.play(False)
        replay.seek(12.0)
        wait_for(lambda: place(feed) == 12.0)
        replay.seek(moment)
        wait_for(lambda: place(feed) == min(moment, SECONDS) and feed.latest().rig)
        latest = feed.latest()
        assert latest.rig is not None
        assert len(latest.rig.placed()) == placed
        assert latest.now == feed.latest().now == min(moment, replay.duration_s)
        assert tabulate_robots(latest).rows[0].cells[1] == "tracked"
        assert latest.server_alive
        assert not latest.faults


def test_a_recording_that_was_cut_off_is_told_to_its_end(recording: Path, tmp_path: Path):
    """And that it was cut off is told too."""
    short = tmp_path / "short.mcap"
    short.write_bytes(recording.read_bytes()[: recording.stat().st_size // 2])
    with told(short) as (replay, feed):
        replay.play(False)
        replay.seek(SECONDS)
        wait_for(lambda: place(feed) > 0)
        assert 1 < replay.duration_s < SECONDS
        assert feed.latest().faults["end: the recording was cut off"] == 1


def test_without_a_page_it_ends_with_the_recording(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    """One line a second, the last of them on the recording's end."""
    with RecordingWriter(tmp_path / "short.mcap") as writer:
        Recorded(writer).pose("rover", (0.5, 0.0, 0.0))
    replay(tmp_path / "short.mcap", Options(headless=True), threading.Event())
    assert "rover tracked at +0.50 +0.00 +0.00" in capsys.readouterr().out.splitlines()[-1]


def test_what_is_no_recording_is_told(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"none.mcap can't be read: No such file.*check the path"):
        RecordingPlayer(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("no recording")
    with pytest.raises(ConfigError, match="is not an MCAP recording"):
        RecordingPlayer(tmp_path / "text.mcap")
    with RecordingWriter(tmp_path / "other.mcap") as writer:
        writer.put("weather", b"rain", START_NS)
    with pytest.raises(ConfigError, match="holds no arena; record with"):
        RecordingPlayer(tmp_path / "other.mcap")


def test_the_page_has_controls_that_follow_the_recording(recording: Path):
    """The slider stands at the moment, the button says what it would do."""
    with told(recording) as (replay, feed):
        view = View(feed, port=free_port())
        controls = ReplayControls(view.server, replay)
        view.add(controls)
        replay.play(False)
        replay.seek(7.5)
        wait_for(lambda: place(feed) == 7.5)
        view.update()
        assert controls._moment.value == 7.5
        assert controls._button.label == "Play"
        assert replay.seconds() == 7.5, "the page's own update is no jump"
        view.close()
