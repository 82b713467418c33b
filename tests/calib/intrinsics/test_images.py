# SPDX-License-Identifier: BSD-3-Clause
"""Images of folders, videos and running cameras have names."""

import threading
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.intrinsics.images import find_cameras, read_frames, take_snapshots
from camera_node.foundation.errors import CameraError
from camera_node.protocol.messages import Keys
from camera_node.protocol.requests import encode_jpeg, parse_quality, respond
from camera_node.protocol.session import open_client, open_router

IMAGE = np.add.outer(np.arange(48), np.arange(64)).astype(np.uint8)


def test_folders_and_videos_are_found_and_read(tmp_path: Path):
    (tmp_path / "north").mkdir()
    for name in ("b.png", "a.jpg"):
        cv2.imwrite(str(tmp_path / "north" / name), IMAGE)
    writer = cv2.VideoWriter(str(tmp_path / "south.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for _ in range(3):
        writer.write(cv2.cvtColor(IMAGE, cv2.COLOR_GRAY2BGR))
    writer.release()
    found = find_cameras(tmp_path, None)
    assert list(found) == ["north", "south"]
    assert [name for name, _ in read_frames(found["north"])] == ["a.jpg", "b.png"]
    frames = list(read_frames(found["south"]))
    assert [name for name, _ in frames] == ["frame 0", "frame 1", "frame 2"]
    assert frames[0][1].shape == IMAGE.shape
    assert list(find_cameras(tmp_path / "north", None)) == ["north"]
    assert list(find_cameras(tmp_path / "south.avi", "east")) == ["east"]
    with pytest.raises(CameraError, match="no frames of west"):
        find_cameras(tmp_path, "west")


def test_a_running_camera_sends_snapshots(endpoint: str):
    """With the camera's own encoder, in the requested quality."""
    requested = threading.Event()

    def answer(query) -> bytes:
        requested.set()
        return encode_jpeg(IMAGE, parse_quality(query.parameters))

    with open_router([endpoint]) as router, open_client([endpoint]) as client:
        key = Keys("test").snapshot("north")
        queryable = router.declare_queryable(key, partial(respond, answer=answer))
        images = take_snapshots(client, "test", "north", 20.0)
        (first, image), (second, _) = next(images), next(images)
        queryable.undeclare()
    assert requested.is_set()
    assert (first, second) == ("snapshot 0", "snapshot 1")
    assert np.abs(image.astype(int) - IMAGE).max() <= 8  # JPEG of quality 95 on a ramp


@pytest.mark.parametrize(("seconds", "silent_s"), [(60.0, 0.2), (0.2, 60.0)])
def test_a_missing_camera_is_named(endpoint: str, seconds: float, silent_s: float):
    """After either time limit."""
    with (
        open_router([endpoint]),
        open_client([endpoint]) as client,
        pytest.raises(CameraError, match="camera 'north' sends no images"),
    ):
        next(take_snapshots(client, "test", "north", seconds, silent_s))
