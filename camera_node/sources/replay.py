# SPDX-License-Identifier: BSD-3-Clause
"""Frames of a folder or a video, and their replay as if they came from a camera."""

import csv
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from camera_node.arrays import Grey
from camera_node.errors import CameraError
from camera_node.sources.frame import Frame, Source, SourceSettings
from camera_node.sources.grey import grey

IMAGES = (".png", ".jpg", ".jpeg")  # files that hold one frame


class FolderSource:
    """A folder of frames `<t_ns>.png|jpg` in the order of their times."""

    def __init__(self, folder: Path) -> None:
        """Raises CameraError where the folder is missing, or holds no frames named by their capture time."""
        if not folder.is_dir():
            raise CameraError(f"{folder} is no folder; frames are expected as {folder}/<t_ns>.png or .jpg")
        files = [path for path in folder.iterdir() if path.suffix.lower() in IMAGES]
        if bad := [path.name for path in files if not re.fullmatch(r"[0-9]{1,19}", path.stem)]:
            raise CameraError(
                f"{folder / min(bad)} is not named by its capture time in nanoseconds, as <t_ns>.png"
            )
        if not files:
            raise CameraError(f"{folder} holds no frames; they are expected as {folder}/<t_ns>.png or .jpg")
        self.files = sorted(files, key=lambda path: int(path.stem))

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[Frame]:
        return (Frame(read_grey(path), int(path.stem)) for path in self.files)

    def close(self) -> None:
        pass


class VideoSource:
    """A video file. Its times are those of `timestamps.csv` beside it, else the frames come at a steady rate."""

    def __init__(self, path: Path, fps: float | None = None) -> None:
        """Raises CameraError where OpenCV can't read the file, or its times are unknown or don't fit."""
        self.path = path
        video = self._open()
        fps = fps or video.get(cv2.CAP_PROP_FPS)
        video.release()
        self.times = read_timestamps(path)
        if self.times is None and not 0 < fps < 1e6:
            raise CameraError(f"{path} does not say its frames a second; give --fps")
        self.period_ns = 1e9 / fps if fps > 0 else 0.0

    def _open(self) -> cv2.VideoCapture:
        video = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        if not video.isOpened():
            raise CameraError(f"{self.path} is no video that OpenCV reads, no folder of frames and no camera")
        return video

    def __iter__(self) -> Iterator[Frame]:
        video = self._open()
        try:
            k = 0
            while (image := video.read()[1]) is not None:
                yield Frame(grey(image), self._time(k))
                k += 1
        finally:
            video.release()

    def _time(self, k: int) -> int:
        if self.times is None:
            return round(k * self.period_ns)
        if k >= len(self.times):
            raise CameraError(f"{self.path} has more than the {len(self.times)} frames in its timestamps.csv")
        return self.times[k]

    def close(self) -> None:
        pass


def read_timestamps(video: Path) -> list[int] | None:
    """The times (ns) of a video's frames from `timestamps.csv` beside it; None where there is no such file.

    The columns `frame_time` (seconds) and `cam_id` (the video's name, or the number it ends with) are used; without
    a `cam_id` the file speaks of one camera.

    Raises:
        CameraError: the file is broken or has no row of this video's.
    """
    path = video.with_name("timestamps.csv")
    if not path.is_file():
        return None
    number = re.search(r"\d*$", video.stem)
    ours = {video.stem, number.group() if number else "", None}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            times = [
                round(float(row["frame_time"]) * 1e9)
                for row in csv.DictReader(file)
                if row.get("cam_id") in ours
            ]
    except (KeyError, TypeError, ValueError, OverflowError):
        raise CameraError(f"{path} needs the columns cam_id and frame_time, in seconds") from None
    if not times:
        raise CameraError(f"{path} has no row whose cam_id is that of {video.name}")
    return sorted(times)


class PacedSource:
    """A recording delivered at its own pace or as fast as it is read, with its own times or moved to now."""

    def __init__(self, recording: Source, settings: SourceSettings) -> None:
        self.recording, self.settings = recording, settings
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        begun, lead = time.time_ns(), None
        for frame in self.recording:
            if lead is None:
                lead = self._lead(frame.t_ns, begun)
            due = lead + frame.t_ns
            wait_s = (due - time.time_ns()) / 1e9
            if self._closed.wait(max(0.0, wait_s) if self.settings.pace == "recorded" else 0.0):
                return
            stamp = due if self.settings.stamps == "now" else frame.t_ns
            yield Frame(frame.image, stamp, frame.exposure_us)

    def _lead(self, first_ns: int, now_ns: int) -> int:
        """What to add to a recorded time to have the time at which the frame is due."""
        if self.settings.stamps == "now" and self.settings.epoch_ns is not None:
            return self.settings.epoch_ns
        return now_ns - first_ns

    def close(self) -> None:
        self._closed.set()
        self.recording.close()


def read_grey(path: Path) -> Grey:
    """The grey image (h, w) uint8 of a file of 8 to 16 bits.

    Raises:
        CameraError: the file is missing or is no image.
    """
    if not path.is_file():
        raise CameraError(f"{path} does not exist; check the path")
    depth = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    image = cv2.imdecode(np.fromfile(path, np.uint8), depth) if path.stat().st_size else None
    if image is None:
        raise CameraError(f"{path} is no image that OpenCV reads; give a PNG or JPEG file")
    return grey(image)
