# SPDX-License-Identifier: BSD-3-Clause
"""Recordings: frames, times and errors."""

import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_node.commands.publish import open_source
from camera_node.foundation.errors import CameraError, ConfigError
from camera_node.sources.frame import Frame, SourceSettings
from camera_node.sources.recorded_frames import FrameFolder, VideoFile, read_grey

MS = 1_000_000
FAST = SourceSettings(pace="fast")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Frames at 0, 30, 60 and 90 ms after 10 s, written out of order; their grey level is 0, 30, 60, 90."""
    for ms in (60, 0, 90, 30):
        cv2.imwrite(str(tmp_path / f"{(10_000 + ms) * MS:012d}.png"), np.full((4, 6), ms, np.uint8))
    return tmp_path


def video(path: Path, n: int = 3) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (64, 48))
    for k in range(n):
        writer.write(np.full((48, 64, 3), 50 * k, np.uint8))
    writer.release()
    return path


def times(source: Iterable[Frame]) -> list[int]:
    return [frame.t_ns for frame in source]


def test_frames_of_a_folder_are_in_order_of_time(folder: Path):
    frames = list(open_source(str(folder), FAST))
    assert [(frame.t_ns // MS, frame.image[0, 0]) for frame in frames] == [
        (10_000 + k, k) for k in (0, 30, 60, 90)
    ]
    assert len(FrameFolder(folder)) == 4


def test_a_replay_has_the_recorded_rate(folder: Path):
    """No frame is delivered before it is due; delays depend on the machine and are not tested."""
    begun = time.time_ns()
    for k, _ in enumerate(open_source(str(folder), SourceSettings())):
        assert time.time_ns() - begun >= 30 * k * MS


def test_stamps_can_be_shifted_to_now(folder: Path):
    """The first stamp is now and the intervals are unchanged; with an epoch, the recording's time 0 is the epoch."""
    before = time.time_ns()
    moved = times(open_source(str(folder), SourceSettings(pace="fast", stamps="now")))
    assert before <= moved[0] <= time.time_ns()
    assert [t - moved[0] for t in moved] == [0, 30 * MS, 60 * MS, 90 * MS]
    epoch = SourceSettings(pace="fast", stamps="now", epoch_ns=5 * 10**17)
    assert times(open_source(str(folder), epoch))[0] == 5 * 10**17 + 10_000 * MS


def test_closing_ends_a_replay_that_waits(tmp_path: Path):
    """The second frame is due in an hour."""
    for t_ns in (0, 3600 * 10**9):
        cv2.imwrite(str(tmp_path / f"{t_ns}.png"), np.zeros((4, 6), np.uint8))
    source = open_source(str(tmp_path), SourceSettings())
    first = threading.Event()
    thread = threading.Thread(target=lambda: [first.set() for _ in source])
    thread.start()
    assert first.wait(10)
    source.close()
    thread.join(10)
    assert not thread.is_alive()


def test_a_video_without_times_uses_its_frame_rate(tmp_path: Path):
    path = video(tmp_path / "cam0.avi")
    assert times(VideoFile(path)) == [0, 40 * MS, 80 * MS]
    assert times(VideoFile(path, fps=100)) == [0, 10 * MS, 20 * MS]


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ("cam_id,frame_time\n0,1.5\n1,7\n0,1.7\n0,1.9", [1500 * MS, 1700 * MS, 1900 * MS]),
        ("cam_id,frame_time\ncam0,1\ncam0,2\ncam0,3", [1000 * MS, 2000 * MS, 3000 * MS]),
        ("frame_time\n1\n2\n3", [1000 * MS, 2000 * MS, 3000 * MS]),
    ],
)
def test_the_times_of_a_video_come_from_the_file_in_its_folder(
    tmp_path: Path, rows: str, expected: list[int]
):
    (tmp_path / "timestamps.csv").write_text(rows)
    assert times(VideoFile(video(tmp_path / "cam0.avi"))) == expected


@pytest.mark.parametrize(
    ("rows", "fault"),
    [
        ("cam_id,time\n0,1", "needs the columns"),
        ("cam_id,frame_time\n0,one", "needs the columns"),
        ("cam_id,frame_time\n0,inf", "needs the columns"),
        ("cam_id,frame_time\n5,1", "no row whose cam_id"),
        ("cam_id,frame_time\n0,1\n0,2", "more than the 2 frames"),
    ],
)
def test_an_error_names_invalid_times(tmp_path: Path, rows: str, fault: str):
    (tmp_path / "timestamps.csv").write_text(rows)
    with pytest.raises(CameraError, match=fault):
        times(VideoFile(video(tmp_path / "cam0.avi")))


def test_real_videos_have_the_times_of_their_cameras(shared_data: Callable[[str], Path]):
    """Free-running webcams: each has its own 111 times, in rising order."""
    folder = shared_data("webcams")
    starts = set()
    for k in range(4):
        source = VideoFile(folder / f"cam_{k}.mp4")
        assert source.times
        assert len(source.times) == 111
        assert source.times == sorted(source.times)
        starts.add(source.times[0])
        frame = next(iter(source))
        assert frame.image.shape == (720, 1280)
        assert frame.t_ns == source.times[0]
    assert len(starts) == 4


def test_an_error_names_the_source_that_does_not_open(tmp_path: Path):
    (tmp_path / "text.mp4").write_text("no video")
    empty, named = tmp_path / "empty", tmp_path / "named"
    empty.mkdir()
    named.mkdir()
    (named / "first.png").write_bytes(b"")
    for text, says in [
        ("nowhere", "no folder, video or camera 'nowhere'"),
        (str(tmp_path / "text.mp4"), "is not a video"),
        (str(empty), "holds no frames"),
        (str(named), r"first\.png .* capture time"),
    ]:
        with pytest.raises(CameraError, match=says):
            open_source(text, SourceSettings())
    with pytest.raises(CameraError, match="is not a folder"):
        FrameFolder(tmp_path / "none")
    with pytest.raises(ConfigError, match="no camera 'cam0'"):
        open_source("sim", SourceSettings())


def test_an_error_names_the_file_that_is_no_image(tmp_path: Path):
    for name, data in (("empty.png", b""), ("text.png", b"text")):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(CameraError, match=f"{name} is not an image"):
            read_grey(tmp_path / name)
    with pytest.raises(CameraError, match="does not exist"):
        read_grey(tmp_path / "none.png")
