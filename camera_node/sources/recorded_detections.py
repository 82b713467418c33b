# SPDX-License-Identifier: BSD-3-Clause
"""Reads recorded detections as `Detections` messages: from folders of frames, or from `observations.csv`."""

import csv
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from camera_node.detection.detector import Detector
from camera_node.detection.roundels import Roundels
from camera_node.foundation.config import require_name, write_table
from camera_node.foundation.errors import CameraError, ConfigError
from camera_node.foundation.terminal import track
from camera_node.protocol.messages import Detections
from camera_node.sources.recorded_frames import IMAGES, FrameFolder, VideoFile, inner_folders

SIGMA_PX = 0.3  # assumed standard deviation of a centre from a file without covariances
MAX_FPS = 1e5
Rows = dict[tuple[int, str], list[tuple[float, float, int, float, float]]]


def detect_frames(folder: Path, **settings) -> list[Detections]:
    """Detect roundels in `<folder>/<camera>/<t_ns>.png|jpg` of all cameras; the messages are in order of time.

    Args:
        folder: contains one folder for each camera, with the camera's name.
        settings: keyword arguments of `Detector`.

    Raises:
        CameraError: the folder is missing or holds no frames, or a frame is not an image.
    """
    if not folder.is_dir():
        raise CameraError(
            f"{folder} is not a folder; frames are expected as {folder}/<camera>/<t_ns>.png or .jpg"
        )
    names = sorted(path.name for path in folder.iterdir() if path.is_dir())
    if not names:
        has_frames = any(path.suffix.lower() in IMAGES for path in folder.iterdir())
        where = (
            f"it has the pictures of one camera: give the folder around it, {folder.absolute().parent}"
            if has_frames
            else f"frames are expected as {folder}/<camera>/<t_ns>.png"
        )
        raise CameraError(f"{folder} contains no camera's folder; {where}")
    if nested := [name for name in names if inner_folders(folder / name)]:
        raise CameraError(
            f"{folder / nested[0]} has folders in place of frames; give the folder whose folders are the cameras, "
            f"such as {folder / nested[0]}"
        )
    sources = {name: FrameFolder(folder / name) for name in names}
    frames = ((name, seq, frame) for name, source in sources.items() for seq, frame in enumerate(source))
    detectors = {name: Detector(**settings) for name in names}
    messages = [
        Detections.pack(
            detectors[name].detect(frame.image),
            camera=name,
            seq=seq,
            t_ns=frame.t_ns,
            width=frame.image.shape[1],
            height=frame.image.shape[0],
        )
        for name, seq, frame in track(frames, f"detecting in {folder}", sum(map(len, sources.values())))
    ]
    return sorted(messages, key=lambda message: message.t_ns)


def detect_video(path: Path, **settings) -> Iterator[Detections]:
    """Detect roundels in a video, frame by frame; the camera has the file's name without its suffix.

    Args:
        path: the video; a `timestamps.csv` beside it has the capture times, else the frame rate gives them from 0.
        settings: keyword arguments of `Detector`.

    Raises:
        CameraError: OpenCV can't read the file.
    """
    detector, camera = Detector(**settings), require_name(path.stem, "a camera")
    for seq, frame in enumerate(VideoFile(path)):
        height, width = frame.image.shape
        found = detector.detect(frame.image)
        yield Detections.pack(found, camera=camera, seq=seq, t_ns=frame.t_ns, width=width, height=height)


def read_observations(
    path: Path, sizes: dict[str, tuple[int, int]] | None = None, fps: float | None = None
) -> list[Detections]:
    """Read `observations.csv`: columns t_ns, camera, u, v and optionally marker, code and sigma_px, one row for each
    centre.

    Instead of t_ns, the number of the frame can be given, in the column frame. A marker's number is that of the body to
    calibrate with, a code is printed.

    Args:
        path: the file.
        sizes: (width, height) of each camera's image; the extent of the observations where it is not given.
        fps: frames a second, for a file with numbers of frames.

    Returns:
        one message for each camera and time, in order of time; `code`, or else `marker`, becomes `id`.

    Raises:
        ConfigError: the file is missing, lacks a column, or has a row with invalid values, or frames without `fps`.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = _read_rows(file, path, fps)
    except OSError as error:
        raise ConfigError(f"{path} can't be read: {error.strerror}; check the path") from None
    except UnicodeDecodeError:
        raise ConfigError(
            f"{path} is not a text file; it needs the columns t_ns,camera,u,v and optionally marker"
        ) from None
    if not rows:
        raise ConfigError(f"{path} holds no observations; add rows of t_ns,camera,u,v")
    extent: dict[str, tuple[int, int]] = {}
    for (_, camera), points in rows.items():
        w, h = extent.get(camera, (1, 1))
        extent[camera] = (max(w, *(int(p[0]) + 1 for p in points)), max(h, *(int(p[1]) + 1 for p in points)))
    seqs: dict[str, int] = {}
    return [
        _message(key, rows[key], seqs, (sizes or extent).get(key[1], extent[key[1]])) for key in sorted(rows)
    ]


def write_observations(path: Path, messages: Iterable[Detections]) -> None:
    """Write detections as `observations.csv`; it appears complete or not at all.

    Raises:
        ConfigError: the file can't be written.
    """
    write_table(path, "t_ns,camera,u,v,marker,code", _flatten(messages))


def _flatten(messages: Iterable[Detections]) -> Iterator[tuple]:
    for message in messages:
        for roundel in message.unpack():
            u, v = (f"{pixels:.4f}" for pixels in roundel.uv)
            is_code = math.isfinite(roundel.id_probability)
            yield message.t_ns, message.camera, u, v, *((None, roundel.id) if is_code else (roundel.id, None))


def _read_rows(file: Iterable[str], path: Path, fps: float | None) -> Rows:
    reader = csv.DictReader(file)
    read_time = _choose_clock(path, set(reader.fieldnames or ()), fps)
    rows: Rows = {}
    for row in reader:
        try:
            u, v, code = float(row["u"]), float(row["v"]), row.get("code")
            number = int(code or row.get("marker") or -1)
            sigma = float(row.get("sigma_px") or SIGMA_PX)
            t_ns, in_range = (
                read_time(row),
                abs(u) < 1e5 and abs(v) < 1e5 and 0 < sigma < 1e4,
            )  # False for NaN
            if not (in_range and row["camera"] and 0 <= t_ns < 2**63 and -1 <= number < 2**31):
                raise ValueError
            rows.setdefault((t_ns, row["camera"]), []).append(
                (u, v, number, sigma, 1.0 if code else math.nan)
            )
        except (TypeError, ValueError, OverflowError):
            raise ConfigError(
                f"{path}, line {reader.line_num}: invalid values; t_ns and frame must be integers, u and v pixels, "
                "sigma_px above 0"
            ) from None
    return rows


def _choose_clock(path: Path, columns: set[str], fps: float | None) -> Callable[[dict[str, str]], int]:
    """The function that gives the time of a row, from t_ns, or from the number of the frame and the rate.

    Raises:
        ConfigError: a column is missing, or the rate.
    """
    by_frame = "frame" in columns and "t_ns" not in columns
    if missing := {"camera", "u", "v", "frame" if by_frame else "t_ns"} - columns:
        raise ConfigError(f"{path} lacks the column {', '.join(sorted(missing))}; it needs t_ns,camera,u,v")
    if not by_frame:
        return lambda row: int(row["t_ns"])
    if fps is None or not 0 < fps < MAX_FPS:
        raise ConfigError(f"{path} has numbers of frames in place of t_ns; give --fps, frames a second")
    return lambda row: round(int(row["frame"]) / fps * 1e9)


def _message(key: tuple[int, str], points: list, seqs: dict[str, int], size: tuple[int, int]) -> Detections:
    t_ns, camera = key
    seqs[camera] = seqs.get(camera, -1) + 1
    columns = np.array(points)
    roundels = Roundels.from_points(columns[:, :2], columns[:, 3], columns[:, 2].astype(np.int32))
    roundels = replace(roundels, id_probability=columns[:, 4])
    width, height = size
    return Detections.pack(roundels, camera=camera, seq=seqs[camera], t_ns=t_ns, width=width, height=height)
