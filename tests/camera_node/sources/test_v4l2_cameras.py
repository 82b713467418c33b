# SPDX-License-Identifier: BSD-3-Clause
"""Video4Linux cameras without hardware: names, settings and capture times."""

from pathlib import Path

import cv2
import pytest

from camera_node.commands.publish import open_source
from camera_node.foundation.errors import CameraError
from camera_node.sources.frame import SourceSettings
from camera_node.sources.v4l2_cameras import camera_names, capture_time, find_device, open_capture, properties


@pytest.fixture
def sys_root(tmp_path: Path) -> Path:
    """A /sys/class/video4linux with two equal cameras, each with a metadata device, and a third camera."""
    for number, (name, index) in enumerate(
        [("HD Webcam", 0), ("HD Webcam", 1), ("HD Webcam", 0), ("HD Webcam", 1), ("Arducam OV9281", 0)]
    ):
        entry = tmp_path / f"video{number}"
        entry.mkdir()
        (entry / "name").write_text(name + "\n")
        (entry / "index").write_text(f"{index}\n")
    return tmp_path


@pytest.mark.parametrize(
    ("text", "device"),
    [("2", "/dev/video2"), ("/dev/video7", "/dev/video7"), ("Arducam OV9281", "/dev/video4")],
)
def test_cameras_are_found_by_number_path_and_name(sys_root: Path, text: str, device: str):
    assert find_device(text, sys_root) == Path(device)


def test_metadata_devices_are_not_listed(sys_root: Path):
    assert [str(path) for path in camera_names(sys_root)] == ["/dev/video0", "/dev/video2", "/dev/video4"]


def test_an_error_lists_the_cameras_when_a_name_is_unknown_or_ambiguous(sys_root: Path, tmp_path: Path):
    with pytest.raises(CameraError, match=r"several .* /dev/video0, /dev/video2"):
        find_device("HD Webcam", sys_root)
    with pytest.raises(CameraError, match=r"'nope'; cameras present: .*/dev/video4 \(Arducam OV9281\)"):
        find_device("nope", sys_root)
    with pytest.raises(CameraError, match="has no camera"):
        find_device("nope", tmp_path / "none")


def test_an_error_names_the_missing_device():
    with pytest.raises(CameraError, match="/dev/video99 does not exist"):
        open_source("99", SourceSettings())
    with pytest.raises(CameraError, match="is not a camera"):
        open_capture(Path("/dev/null"), SourceSettings())


def test_settings_become_properties_in_the_order_that_v4l2_needs():
    """The format comes before the size and the rate."""
    settings = SourceSettings(width=1280, height=720, fps=60, fourcc="MJPG")
    assert properties(settings) == [
        (cv2.CAP_PROP_FOURCC, 0x47504A4D),
        (cv2.CAP_PROP_FRAME_WIDTH, 1280),
        (cv2.CAP_PROP_FRAME_HEIGHT, 720),
        (cv2.CAP_PROP_FPS, 60),
    ]
    assert properties(SourceSettings()) == []
    raw = [(cv2.CAP_PROP_FOURCC, 0x20303159), (cv2.CAP_PROP_CONVERT_RGB, 0)]
    assert properties(SourceSettings(fourcc="Y10 ")) == raw


UNIX, MONOTONIC, MS = 1_700_000_000_000_000_000, 5_000_000_000_000, 1_000_000


@pytest.mark.parametrize(
    ("stamp_ms", "exposure_us", "expected"),
    [
        (5_000_000 - 20, 0, UNIX - 20 * MS),  # 20 ms old
        (5_000_000 - 20, 4000, UNIX - 22 * MS),  # its exposure of 4 ms ended then
        (0, 4000, UNIX - 2 * MS),  # no stamp: the time of the grab
        (5_000_000 + 20, 0, UNIX),  # from the future
        (5_000_000 - 1500, 0, UNIX),  # too old to be valid
        (float("nan"), 0, UNIX),
    ],
)
def test_buffer_stamps_become_unix_times(stamp_ms: float, exposure_us: float, expected: int):
    """The spacing of doubles of this size is 256 ns."""
    assert abs(capture_time(stamp_ms, MONOTONIC, UNIX, exposure_us) - expected) <= 256
