# SPDX-License-Identifier: BSD-3-Clause
"""Recorded frames in a folder or a video file, and their replay at the recorded rate."""

import csv
import re
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from camera_node.foundation.arrays import Grey
from camera_node.foundation.errors import CameraError
from camera_node.protocol.registration import CameraAssignment
from camera_node.sources.frame import Frame, Source, SourceSettings
from camera_node.sources.grey import to_grey

VIDEOS = (".mp4", ".avi", ".mkv", ".mov")
IMAGES = (".png", ".jpg", ".jpeg")  # suffixes of files that hold one frame


def inner_folders(folder: Path) -> str:
    """The advice to give a folder inside this one; empty if it has none."""
    names = sorted(path.name for path in folder.iterdir() if path.is_dir())
    return f"it has folders: give {folder / names[0]}" if names else ""


class FrameFolder:
    """A folder of frames `<t_ns>.png|jpg`; iterating yields them in order of time."""

    def __init__(self, folder: Path) -> None:
        """Raises CameraError where the folder is missing or holds no frames named by their capture time."""
        if not folder.is_dir():
            raise CameraError(f"{folder} is not a folder; frames are expected as {folder}/<t_ns>.png or .jpg")
        files = [path for path in folder.iterdir() if path.suffix.lower() in IMAGES]
        if bad := [path.name for path in files if not re.fullmatch(r"[0-9]{1,19}", path.stem)]:
            raise CameraError(
                f"{folder / min(bad)} is not named by its capture time in nanoseconds; rename it to <t_ns>.png"
            )
        if not files:
            where = inner_folders(folder) or f"they are expected as {folder}/<t_ns>.png or .jpg"
            raise CameraError(f"{folder} holds no frames; {where}")
        self.files = sorted(files, key=lambda path: int(path.stem))

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[Frame]:
        return (Frame(read_grey(path), int(path.stem)) for path in self.files)


class VideoFile:
    """A video file; iterating yields its frames.

    The capture times come from `timestamps.csv` in the same folder, otherwise from the frame rate.
    """

    def __init__(self, path: Path, fps: float | None = None) -> None:
        """Raises CameraError where OpenCV can't read the file, or `timestamps.csv` or the frame rate is invalid."""
        self.path = path
        video = self._open()
        fps = fps or video.get(cv2.CAP_PROP_FPS)
        video.release()
        self.times = read_timestamps(path)
        if self.times is None and not 0 < fps < 1e6:
            raise CameraError(f"{path} does not state its frame rate; give --fps")
        self.period_ns = 1e9 / fps if fps > 0 else 0.0

    def _open(self) -> cv2.VideoCapture:
        video = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        if not video.isOpened():
            raise CameraError(
                f"{self.path} is not a video that OpenCV can read; give a video, a folder of frames or a camera"
            )
        return video

    def __iter__(self) -> Iterator[Frame]:
        video = self._open()
        try:
            k = 0
            while (image := video.read()[1]) is not None:
                yield Frame(to_grey(image), self._time(k))
                k += 1
        finally:
            video.release()

    def _time(self, k: int) -> int:
        if self.times is None:
            return round(k * self.period_ns)
        if k >= len(self.times):
            raise CameraError(f"{self.path} has more than the {len(self.times)} frames in its timestamps.csv")
        return self.times[k]


def read_timestamps(video: Path) -> list[int] | None:
    """Read the capture times (ns) of a video's frames from `timestamps.csv` in its folder; None without that file.

    Uses the columns `frame_time` (seconds) and `cam_id` (the video's name, or the number at its end). Without `cam_id`,
    all rows belong to the video.

    Raises:
        CameraError: the file lacks a column or a number, or has no row for this video.
    """
    path = video.with_name("timestamps.csv")
    if not path.is_file():
        return None
    number = re.search(r"\d*$", video.stem)
    ids = {video.stem, number.group() if number else "", None}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            times = [
                round(float(row["frame_time"]) * 1e9)
                for row in csv.DictReader(file)
                if row.get("cam_id") in ids
            ]
    except (KeyError, TypeError, ValueError, OverflowError):
        raise CameraError(f"{path} needs the columns cam_id and frame_time, in seconds") from None
    if not times:
        raise CameraError(f"{path} has no row whose cam_id is that of {video.name}; add its frame times")
    return sorted(times)


@dataclass(frozen=True, slots=True)
class ArenaTime:
    """When the frames of a recording count as captured, so that several recordings play together.

    Attributes:
        shift_ns: added to a frame's time, it gives the server's time.
        ahead_ns: the server's time minus this machine's.
    """

    shift_ns: int
    ahead_ns: int

    @classmethod
    def of(cls, assignment: CameraAssignment) -> "ArenaTime | None":
        """The time of a recording that just received its assignment; None for a camera."""
        if assignment.recording_shift_ns is None:
            return None
        return cls(assignment.recording_shift_ns, assignment.t_ns - time.time_ns())


class PacedSource(Source):
    """Replays a recording at its recorded rate or as fast as possible, with its own times or shifted to now."""

    is_recording = True

    def __init__(
        self, recording: Iterable[Frame], settings: SourceSettings, arena_time: "ArenaTime | None" = None
    ) -> None:
        """Replay as `settings` say, or as a live camera in `arena_time`."""
        self._recording, self._settings, self._arena_time = recording, settings, arena_time
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        return self._paced() if self._arena_time is None else self._live(self._arena_time)

    def _live(self, arena_time: "ArenaTime") -> Iterator[Frame]:
        """Frames when they are due; those that were due before the start are skipped, as a live camera's would be."""
        begun_ns = time.time_ns() + arena_time.ahead_ns
        for frame in self._recording:
            due_ns = frame.t_ns + arena_time.shift_ns
            if due_ns < begun_ns:
                continue
            wait_s = (due_ns - time.time_ns() - arena_time.ahead_ns) / 1e9
            if self._closed.wait(max(0.0, wait_s)):
                return
            yield Frame(frame.image, due_ns, frame.exposure_us)

    def _paced(self) -> Iterator[Frame]:
        begun_ns, shift_ns = time.time_ns(), None
        for frame in self._recording:
            if shift_ns is None:
                shift_ns = self._shift(frame.t_ns, begun_ns)
            due_ns = shift_ns + frame.t_ns
            wait_s = (due_ns - time.time_ns()) / 1e9
            if self._closed.wait(max(0.0, wait_s) if self._settings.pace == "recorded" else 0.0):
                return
            stamp_ns = due_ns if self._settings.stamps == "now" else frame.t_ns
            yield Frame(frame.image, stamp_ns, frame.exposure_us)

    def _shift(self, first_ns: int, now_ns: int) -> int:
        """Nanoseconds from a frame's recorded time to the time at which it is due."""
        if self._settings.stamps == "now" and self._settings.epoch_ns is not None:
            return self._settings.epoch_ns
        return now_ns - first_ns

    def close(self) -> None:
        self._closed.set()


def read_grey(path: Path) -> Grey:
    """Read an image file of 8 to 16 bits as grey levels (h, w), uint8.

    Raises:
        CameraError: the file is missing or is not an image.
    """
    if not path.is_file():
        raise CameraError(f"{path} does not exist; check the path")
    depth = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    image = cv2.imdecode(np.fromfile(path, np.uint8), depth) if path.stat().st_size else None
    if image is None:
        raise CameraError(f"{path} is not an image that OpenCV can read; give a PNG or JPEG file")
    return to_grey(image)
