# SPDX-License-Identifier: BSD-3-Clause
"""The options by which subcommands take their input, and the reading of recordings."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from calib.errors import CalibrationError
from calib.rig.recording import read_detections
from calib.rig.rig import Rig
from calib.wand.scale import SIGMA_M, Distance
from camera_node.foundation.config import example_file
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from camera_node.sources.recorded_detections import detect_frames, read_observations

Synchronised = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(aliases=["--synchronized"])]


@dataclass(frozen=True, kw_only=True)
class WandOptions:
    """The options of every calibration from a wand recording."""

    wand: Path = field(default_factory=partial(example_file, "wand.yaml"))
    """The wand: markers, and diameter_m unless they are lights or points; metres."""
    frames: Path | None = None
    """Detect in <FOLDER>/<camera>/<t_ns>.png|jpg."""
    observations: Path | None = None
    """Or read marker centres from a CSV: t_ns,camera,u,v[,marker,sigma_px]; or with a column frame in place of t_ns."""
    fps: float | None = None
    """Frames a second, for a CSV with numbers of frames."""
    recording: Path | None = None
    """Or read a recording (MCAP) of roundel calibrate wand --live or of roundel record."""
    distance: tuple[str, str, float] | None = None
    """Two cameras and the metres between their lenses: the scale for a wand of one marker, else a check of the wand."""
    distance_sigma: float = SIGMA_M
    """Standard deviation of that distance, metres."""
    synchronised: Synchronised = False
    """The cameras are triggered together: frames with equal stamps are simultaneous. Without this option, cameras whose
    stamps are equal count as synchronous unless clock offsets fit the recording better."""
    height: float = 0.1
    """Height of the robots' roundels above the floor, metres, for which errors are predicted."""
    maps: Path | None = None
    """A folder for images: each camera's residuals and where to wave next, and the expected errors."""

    def require_recording(self, **others: object) -> None:
        """Raise ConfigError unless exactly one recording is given, or one of the `others`, which are flags by name."""
        files = {"--frames FOLDER": self.frames, "--observations CSV": self.observations}
        flags = {f"--{name}": value for name, value in others.items()}
        require_one({**files, "--recording MCAP": self.recording, **flags})

    def read_recording(self, rig: Rig, wand: Body, any_camera: bool = False) -> list[Detections]:
        """The detections of the given recording; see `read_recording`."""
        require_several_cameras(self.frames)
        given = self.frames, self.observations, self.recording
        return read_recording(rig, *given, wand, self.fps, any_camera)

    def measured_distance(self, rig: Rig) -> Distance | None:
        """The given distance.

        Raises:
            CalibrationError: it is not a distance of two of the rig's cameras.
        """
        return Distance.of(self.distance, self.distance_sigma, list(rig.cameras))


def require_one(options: Mapping[str, object], purpose: str = "") -> None:
    """Raise ConfigError unless exactly one of the options, by the names in the error, is neither None nor False."""
    if sum(value is not None and value is not False for value in options.values()) != 1:
        *most, last = options
        raise ConfigError(f"give one of {', '.join(most)} and {last}{purpose}")


def require_positive(seconds: float | None) -> None:
    """Raise ConfigError unless `--seconds` is above 0 or not given."""
    if seconds is not None and not seconds > 0:
        raise ConfigError(f"--seconds is {seconds}; it must be above 0")


def read_recording(
    rig: Rig,
    frames: Path | None,
    observations: Path | None,
    recording: Path | None = None,
    body: Body | None = None,
    fps: float | None = None,
    any_camera: bool = False,
) -> list[Detections]:
    """Read detections from one of: a folder of frames, a CSV of observations, an MCAP recording.

    Args:
        rig: the cameras of the recording.
        frames: `<folder>/<camera>/<t_ns>.png|jpg`; roundels are detected.
        observations: CSV of marker centres.
        recording: MCAP of detections.
        body: the wand or frame, whose roundels are detected in `frames`.
        fps: frames a second, for observations with numbers of frames.
        any_camera: whether folders of frames may be of cameras that the rig lacks.

    Raises:
        ConfigError, CameraError, CalibrationError: the input is unusable, or a camera is not in the rig.
    """
    if frames is not None:
        if not any_camera:
            _check_folders(frames, rig)
        return detect_frames(frames, **({"inner_ratios": (body.inner_ratio,)} if body else {}))
    if recording is not None:
        return read_detections(recording)
    assert observations is not None
    sizes = {name: (lens.width, lens.height) for name, lens in rig.cameras.items()}
    return read_observations(observations, sizes, fps)


def require_several_cameras(frames: Path | None) -> None:
    """Raise CalibrationError if a folder of frames has one camera only, before detection takes minutes."""
    names = _camera_folders(frames) if frames is not None else []
    if len(names) == 1:
        raise CalibrationError(f"{frames} holds one camera, '{names[0]}'; triangulation needs two or more")


def _camera_folders(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []


def _check_folders(folder: Path, rig: Rig) -> None:
    """Raise CalibrationError for camera folders that can't be used, before detection takes minutes."""
    names = _camera_folders(folder)
    if unknown := [name for name in names if name not in rig.cameras]:
        raise CalibrationError(
            f"camera '{unknown[0]}' of {folder} is not in the rig, which has {', '.join(sorted(rig.cameras))}; rename "
            f"the folder, or run roundel calibrate intrinsics --camera {unknown[0]}"
        )
