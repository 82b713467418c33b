# SPDX-License-Identifier: BSD-3-Clause
"""Pictures of a board: out of folders and videos, or from a running camera, each with a name to call it by."""

import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import zenoh

from camera_node.arrays import Grey
from camera_node.errors import CameraError
from camera_node.protocol.messages import Keys
from camera_node.sources.grey import to_grey
from camera_node.sources.replay import IMAGES, read_grey

VIDEOS = (".mp4", ".avi", ".mkv", ".mov")
MAX_FRAMES = 600  # of a video that are looked at, evenly spread: a lens needs 60 good ones
REPLY_S = 2.0  # for a camera to answer with a picture
PATIENCE_S = 5.0  # without any answer: then the camera is not there
PAUSE_S = 0.1  # between two questions that nobody answers
QUALITY = 95  # of the JPEG that is asked for: artefacts move corners

Picture = tuple[str, Grey]


def find_cameras(path: Path, camera: str | None) -> dict[str, Path]:
    """Where each camera's frames are: `<path>/<camera>/`, a folder of images, or videos named like cameras.

    Raises:
        CameraError: nothing is there, or the camera of the frames has no name.
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


def read_frames(path: Path) -> Iterator[Picture]:
    """Names and grey images of a folder, or of a video's frames.

    Raises:
        CameraError: the folder holds no images, a file is no image, or the file is no video.
    """
    if not path.is_dir():
        yield from _read_video(path)
        return
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGES)
    if not files:
        raise CameraError(f"{path} holds no PNG or JPEG images")
    yield from ((file.name, read_grey(file)) for file in files)


def _read_video(path: Path) -> Iterator[Picture]:
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise CameraError(f"{path} is no video that OpenCV reads")
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
    session: zenoh.Session, arena: str, camera: str, seconds: float, patience_s: float = PATIENCE_S
) -> Iterator[Picture]:
    """Pictures of a running camera, one after the other, for a while.

    Raises:
        CameraError: the camera does not answer for `patience_s`, or at all, or answers with what is no picture.
    """
    key = f"{Keys(arena).snapshot(camera)}?quality={QUALITY}"
    begun = heard = time.monotonic()
    number = 0
    while (now := time.monotonic()) - begun < seconds:
        image = _ask(session, key, camera)
        if image is not None:
            heard = now
            yield f"snapshot {number}", image
            number += 1
        elif now - heard > patience_s:
            break
        else:
            time.sleep(PAUSE_S)
    if number == 0 or now - heard > patience_s:
        raise CameraError(
            f"camera '{camera}' sends no pictures on {Keys(arena).snapshot(camera)}; do the server and the "
            "camera run, and are --camera, --connect and --arena right?"
        )


def _ask(session: zenoh.Session, key: str, camera: str) -> Grey | None:
    """One picture; None where nobody answers in time."""
    for reply in session.get(key, timeout=REPLY_S):
        if reply.ok is None:
            continue  # it timed out, or the camera has no picture yet
        image = cv2.imdecode(np.frombuffer(reply.ok.payload.to_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise CameraError(f"camera '{camera}' answered with bytes that are no picture")
        return np.ascontiguousarray(image, np.uint8)
    return None
