# SPDX-License-Identifier: BSD-3-Clause
"""Reads recordings for programs, one message after the other."""

from collections import Counter
from collections.abc import Collection, Iterator
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack

import numpy as np
from numpy.typing import NDArray

from calib.rig.recording import as_they_arrived, read_decoded, read_messages
from calib.rig.rig import Rig
from camera_node.detection.detector import SettingKeywords
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.extras import require
from camera_node.protocol.messages import Detections
from camera_node.sources.recorded_detections import detect_frames, detect_video, read_observations
from camera_node.sources.recorded_frames import VIDEOS
from fusion.export.plots import draw_recording, read_curves
from fusion.model.limits import Limits
from fusion.protocol.pose_messages import RobotPose, Robots
from fusion.recordings.arena_recording import ArenaRecording
from fusion.recordings.recording_files import summarize_recording

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

Kind = Literal["poses", "detections"]
Fields = dict[str, tuple[str, tuple[int, ...]]]  # of one row: type and shape by name
NAME = "<U64"
POSES: Fields = {
    "t_ns": ("<i8", ()),
    "robot": (NAME, ()),
    "position": ("<f8", (3,)),
    "quaternion_wxyz": ("<f8", (4,)),
    "velocity": ("<f8", (3,)),
    "angular_velocity": ("<f8", (3,)),
    "state": ("<U8", ()),
    "n_markers": ("<i4", ()),
    "n_cameras": ("<i4", ()),
    "covariance": ("<f4", (12, 12)),
}
DETECTIONS: Fields = {
    "t_ns": ("<i8", ()),
    "camera": (NAME, ()),
    "uv": ("<f8", (2,)),
    "cov": ("<f8", (2, 2)),
    "axes_px": ("<f8", (2,)),
    "angle_rad": ("<f8", ()),
    "ratio": ("<f8", ()),
    "contrast": ("<f8", ()),
    "id": ("<i4", ()),
    "track": ("<i4", ()),
}
# The columns of `to_pandas` that hold the elements of an array; poses have the columns of poses.csv.
COLUMNS = {
    "position": ("x", "y", "z"),
    "quaternion_wxyz": ("qw", "qx", "qy", "qz"),
    "velocity": ("vx", "vy", "vz"),
    "angular_velocity": ("wx", "wy", "wz"),
    "covariance": (),
    "uv": ("u", "v"),
    "cov": ("cov_uu", "cov_uv", None, "cov_vv"),
    "axes_px": ("major_px", "minor_px"),
}


class Recording:
    """A recording of an arena. Iterators read the file again each time and hold one message at a time.

        recording = Recording("lab.mcap")
        for pose in recording.poses("rover"):
            print(pose.t_ns, pose.position)

    Args:
        path: one of

            - an MCAP file of `roundel record`, of the page, or of a wand calibration (`rig.wave.mcap`);
            - a folder of frames `<camera>/<t_ns>.png|jpg`, as `simulate` writes it: the roundels of all frames are
              detected when they are first asked for. It may hold a `rig.yaml` and a `robots.yaml`;
            - a video (`.mp4`, `.avi`, `.mkv`, `.mov`) of a camera of its name, with the times of a `timestamps.csv`
              beside it, or from 0 by its frame rate;
            - `observations.csv` with the columns `t_ns,camera,u,v` and optionally `marker` and `sigma_px`.
        settings: of `Detector`, for frames and videos.

    Attributes:
        path: the file or folder.
        faults: counts messages that can't be decoded, and whether the file was cut off, in all reading so far.

    Raises:
        ConfigError: there is no such file or folder. Reading raises it where the file is no recording.
    """

    def __init__(self, path: str | PathLike[str], **settings: Unpack[SettingKeywords]) -> None:
        self.path = Path(path)
        self.faults: Counter[str] = Counter()
        self._settings = settings
        if not self.path.exists():
            raise ConfigError(f"{self.path} does not exist; give a recording, a folder of frames, or a CSV")

    def __repr__(self) -> str:
        return f"Recording({str(self.path)!r})"

    def detections(
        self,
        cameras: str | Collection[str] | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
    ) -> Iterator[Detections]:
        """Yield the roundels of each frame, in the order in which the messages arrived.

        `message.unpack()` gives them as arrays: `uv` (N, 2), `cov` (N, 2, 2) and so on.

        Args:
            cameras: a camera, or several; all unless given.
            start_s, end_s: the part to read, seconds after the recording's beginning.
        """
        names = _names(cameras)
        for message in self._part(self.arrivals(), start_s, end_s):
            if names is None or message.camera in names:
                yield message

    def poses(
        self,
        robots: str | Collection[str] | None = None,
        start_s: float | None = None,
        end_s: float | None = None,
    ) -> Iterator[RobotPose]:
        """Yield the poses that the server published. Only an MCAP file has some; `track` estimates them again.

        Args:
            robots: a robot, or several; all unless given.
            start_s, end_s: the part to read, seconds after the recording's beginning.
        """
        names = _names(robots)
        for pose in self._part(self._decoded("/pose", RobotPose), start_s, end_s):
            if names is None or pose.robot in names:
                yield pose

    @property
    def rig(self) -> Rig | None:
        """The calibration that was in use first; None if the recording has none."""
        return self._context.rig

    @property
    def limits(self) -> Limits | None:
        """The limits of tracking that the server used; None if the recording has none."""
        return self._context.limits

    @property
    def robots(self) -> Robots | None:
        """The declared robots; None if the recording has none."""
        robots = self._context.robots
        return Robots(robots=robots) if robots else None

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras with detections, in alphabetical order."""
        if self._is_folder:
            return tuple(sorted(path.name for path in self.path.iterdir() if path.is_dir()))
        if self.is_mcap and (index := summarize_recording(self.path)).seconds is not None:
            return index.cameras
        return tuple(sorted({message.camera for _, message in self.arrivals()}))

    @property
    def duration_s(self) -> float:
        """Seconds from the first message to the last."""
        first_ns, last_ns = self._span_ns
        return (last_ns - first_ns) / 1e9

    def to_numpy(
        self, kind: Kind = "poses", start_s: float | None = None, end_s: float | None = None
    ) -> NDArray[np.void]:
        """All poses or all detections as a structured array, one row each.

        Args:
            kind: `poses` has the fields `t_ns`, `robot`, `position` (3,), `quaternion_wxyz` (4,), `velocity` (3,),
                `angular_velocity` (3,), `state`, `n_markers`, `n_cameras` and `covariance` (12, 12), as in `RobotPose`.
                `detections` has `t_ns`, `camera`, `uv` (2,), `cov` (2, 2), `axes_px` (2,), `angle_rad`, `ratio`,
                `contrast`, `id` and `track`, one row for each roundel.
            start_s, end_s: the part to read, seconds after the recording's beginning.
        """
        if kind == "poses":
            return _poses_table(list(self.poses(None, start_s, end_s)))
        if kind == "detections":
            return _detections_table(list(self.detections(None, start_s, end_s)))
        raise ConfigError(f"a recording has no '{kind}'; give 'poses' or 'detections'")

    def to_pandas(
        self, kind: Kind = "poses", start_s: float | None = None, end_s: float | None = None
    ) -> "DataFrame":
        """As `to_numpy`, as a DataFrame with a column for each number: poses have the columns of `poses.csv`.

        Raises:
            ConfigError: pandas is not installed.
        """
        pandas = require("pandas", "pandas", "Recording.to_pandas")
        table = self.to_numpy(kind, start_s, end_s)
        columns: dict[str, Any] = {}
        for field in table.dtype.names or ():
            names = COLUMNS.get(field, (field,))
            elements = table[field].reshape(len(table), -1) if len(table) else np.empty((0, len(names)))
            columns |= {name: elements[:, k] for k, name in enumerate(names) if name is not None}
        return pandas.DataFrame(columns)

    def plot(self, robots: str | Collection[str] | None = None) -> "Figure":
        """Draw the trajectories, the positions with two standard deviations, and the residual of each camera
        (`roundel plot`).

        Args:
            robots: a robot, or several; all unless given.

        Raises:
            ConfigError: matplotlib is not installed, or the recording has no poses of these robots.
        """
        return draw_recording(read_curves(self.path, sorted(_names(robots) or ())))

    @property
    def _is_folder(self) -> bool:
        return self.path.is_dir()

    @property
    def _is_video(self) -> bool:
        return self.path.suffix.lower() in VIDEOS

    @property
    def is_mcap(self) -> bool:
        """Whether it is a file of messages, not of frames or of observations."""
        return not (self._is_folder or self._is_video) and self.path.suffix.lower() != ".csv"

    def _decoded(self, suffix: str, kind: type) -> Iterator[tuple[int, Any]]:
        """Yield the time of arrival and the content of the messages on keys that end with `suffix`."""
        return read_decoded(self.path, {suffix: kind}, self.faults) if self.is_mcap else iter(())

    def arrivals(self, rig: Rig | None = None) -> Iterator[tuple[int, Detections]]:
        """Yield the time of arrival (ns) and the message of each frame.

        The messages of frames and CSV files arrive at their true capture times, by the clock offsets of `rig`; a CSV
        has the sizes of images that `rig` has.
        """
        if self.is_mcap:
            yield from self._decoded("/detections", Detections)
        elif self._is_folder or self._is_video:
            yield from as_they_arrived(self._detected, rig.cameras if rig else {})
        else:
            cameras = (rig or self.rig or Rig(cameras={})).cameras
            sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
            yield from as_they_arrived(read_observations(self.path, sizes), rig.cameras if rig else {})

    @cached_property
    def _detected(self) -> list[Detections]:
        if self._is_video:
            return list(detect_video(self.path, **self._settings))
        return detect_frames(self.path, **self._settings)

    @cached_property
    def _context(self) -> ArenaRecording:
        """The rig, the robots and the limits of tracking."""
        context = ArenaRecording(faults=self.faults)
        if self.is_mcap:
            for key, data, _ in read_messages(self.path, self.faults):
                if key.endswith(("/rig", "/robots", "/fusion/status")):
                    context.add(key, data)
            return context
        folder = self.path if self._is_folder else self.path.parent
        if (folder / "rig.yaml").is_file():
            context.rig = Rig.load(folder / "rig.yaml")
        if (folder / "robots.yaml").is_file():
            context.robots = Robots.load(folder / "robots.yaml").robots
        return context

    @cached_property
    def _span_ns(self) -> tuple[int, int]:
        """When the first message arrived, and the last one."""
        if self.is_mcap:
            times = (received_ns for *_, received_ns in read_messages(self.path, self.faults))
        else:
            times = (received_ns for received_ns, _ in self.arrivals())
        first_ns = last_ns = next(times, 0)
        for t_ns in times:
            first_ns, last_ns = min(first_ns, t_ns), max(last_ns, t_ns)
        return first_ns, last_ns

    def _part(
        self, arrivals: Iterator[tuple[int, Any]], start_s: float | None, end_s: float | None
    ) -> Iterator[Any]:
        """Yield the messages that arrived in a part of the recording."""
        if start_s is None and end_s is None:
            yield from (message for _, message in arrivals)
            return
        first_ns = self._span_ns[0]
        begin_ns = first_ns + round((start_s or 0.0) * 1e9)
        end_ns = self._span_ns[1] if end_s is None else first_ns + round(end_s * 1e9)
        for received_ns, message in arrivals:
            if begin_ns <= received_ns <= end_ns:
                yield message


def _names(names: str | Collection[str] | None) -> set[str] | None:
    return None if names is None else {names} if isinstance(names, str) else set(names)


def _poses_table(poses: list[RobotPose]) -> NDArray[np.void]:
    table = _empty_table(POSES, len(poses))
    for field in POSES.keys() - {"n_cameras", "covariance"}:
        values = np.array([getattr(pose, field) for pose in poses], table.dtype[field].base)
        table[field] = values.reshape(table[field].shape)
    table["n_cameras"] = [len(pose.cameras) for pose in poses]
    covariances = np.frombuffer(b"".join(pose.covariance for pose in poses), "<f4")
    table["covariance"] = covariances.reshape(-1, 12, 12)
    return table


def _detections_table(messages: list[Detections]) -> NDArray[np.void]:
    counts = [len(message) for message in messages]
    table = _empty_table(DETECTIONS, sum(counts))
    table["t_ns"] = np.repeat(np.array([message.t_ns for message in messages], np.int64), counts)
    table["camera"] = np.repeat(np.array([message.camera for message in messages], NAME), counts)
    roundels = [message.unpack() for message in messages]
    for field in DETECTIONS.keys() - {"t_ns", "camera"}:
        if roundels:
            table[field] = np.concatenate([getattr(columns, field) for columns in roundels])
    return table


def _empty_table(fields: Fields, n: int) -> NDArray[np.void]:
    return np.zeros(n, np.dtype([(name, *kind) for name, kind in fields.items()]))
