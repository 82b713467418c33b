# SPDX-License-Identifier: BSD-3-Clause
"""Reads named images of a board from folders, videos and running cameras."""

import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import zenoh

from camera_node.foundation.arrays import Grey
from camera_node.foundation.errors import CameraError
from camera_node.protocol.messages import Keys
from camera_node.protocol.requests import RETRY_S
from camera_node.sources.grey import to_grey
from camera_node.sources.recorded_frames import IMAGES, VIDEOS, read_grey

MAX_FRAMES = 600  # read from a video, evenly spaced: a lens needs 60 good ones
REPLY_S = 2.0  # for a camera to answer a request
SILENT_S = 5.0  # without any answer: the camera counts as missing
JPEG_QUALITY = 95  # that is requested: artefacts move corners

NamedImage = tuple[str, Grey]


def find_cameras(path: Path, camera: str | None) -> dict[str, Path]:
    """Find each camera's frames: `<path>/<camera>/`, a folder of images, or videos named like cameras.

    Raises:
        CameraError: there are no frames.
    """
    if path.is_file():
        return {camera or path.stem: path}
    if not path.is_dir():
        raise CameraError(f"{path} does not exist; give a folder of frames, or a video")
    entries = sorted(path.iterdir())
    if any(entry.suffix.lower() in IMAGES for entry in entries):
        return {camera or path.resolve().name: path}
    found = {e.name: e for e in entries if e.is_dir()}
    found |= {e.stem: e for e in entries if e.suffix.lower() in VIDEOS}
    if camera is not None:
        found = {name: entry for name, entry in found.items() if name == camera}
    if not found:
        raise CameraError(
            f"{path} holds no frames{f' of {camera}' if camera else ''}; give {path}/<camera>/*.png"
        )
    return found


def read_frames(path: Path) -> Iterator[NamedImage]:
    """Yield names and grey images of a folder, or of a video.

    Raises:
        CameraError: the folder holds no images, or a file can't be read.
    """
    if not path.is_dir():
        yield from _read_video(path)
        return
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGES)
    if not files:
        raise CameraError(f"{path} holds no PNG or JPEG images")
    yield from ((file.name, read_grey(file)) for file in files)


def _read_video(path: Path) -> Iterator[NamedImage]:
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise CameraError(f"{path} is not a video that OpenCV can read")
    stride = max(1, round(video.get(cv2.CAP_PROP_FRAME_COUNT) / MAX_FRAMES))
    try:
        number = 0
        while video.grab():
            if number % stride == 0 and (image := video.retrieve()[1]) is not None:
                yield f"frame {number}", to_grey(image)
            number += 1
    finally:
        video.release()


def take_snapshots(
    session: zenoh.Session, arena: str, camera: str, seconds: float, silent_s: float = SILENT_S
) -> Iterator[NamedImage]:
    """Request images from a running camera, one after the other, for a number of seconds.

    Raises:
        CameraError: the camera does not answer for `silent_s`, or never, or its answer is not an image.
    """
    key = f"{Keys(arena).snapshot(camera)}?quality={JPEG_QUALITY}"
    start = answered = time.monotonic()
    number = 0
    while (now := time.monotonic()) - start < seconds:
        image = _request(session, key, camera)
        if image is not None:
            answered = now
            yield f"snapshot {number}", image
            number += 1
        elif now - answered > silent_s:
            break
        else:
            time.sleep(RETRY_S)
    if number == 0 or now - answered > silent_s:
        raise CameraError(
            f"camera '{camera}' sends no images on {Keys(arena).snapshot(camera)}; check that the server and the "
            "camera run, and check --camera, --connect and --arena"
        )


def _request(session: zenoh.Session, key: str, camera: str) -> Grey | None:
    """One image; None if there is no answer in time."""
    for reply in session.get(key, timeout=REPLY_S):
        if reply.ok is None:
            continue  # a timeout, or the camera has no image yet
        image = cv2.imdecode(np.frombuffer(reply.ok.payload.to_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise CameraError(f"camera '{camera}' answered with bytes that are not an image")
        return np.ascontiguousarray(image, np.uint8)
    return None
