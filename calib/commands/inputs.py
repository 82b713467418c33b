# SPDX-License-Identifier: BSD-3-Clause
"""Checks the options by which a subcommand takes its input, and reads recordings of wands and roundels."""

from collections.abc import Mapping
from pathlib import Path

from calib.errors import CalibrationError
from calib.rig.recording import read_detections
from calib.rig.rig import Rig
from camera_node.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from camera_node.sources.observations import detect_frames, read_observations


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
) -> list[Detections]:
    """Read detections from one of: a folder of frames, a CSV of observations, an MCAP recording.

    Args:
        rig: the cameras of the recording.
        frames: `<folder>/<camera>/<t_ns>.png|jpg`; roundels are detected.
        observations: CSV of marker centres.
        recording: MCAP of detections.
        body: the wand or frame, whose roundels are detected in `frames`.

    Raises:
        ConfigError, CameraError, CalibrationError: the input is unusable, or a camera is not in the rig.
    """
    if frames is not None:
        _check_folders(frames, rig)
        return detect_frames(frames, **({"inner_ratios": (body.inner_ratio,)} if body else {}))
    if recording is not None:
        return read_detections(recording)
    assert observations is not None
    sizes = {name: (lens.width, lens.height) for name, lens in rig.cameras.items()}
    return read_observations(observations, sizes)


def _check_folders(folder: Path, rig: Rig) -> None:
    """Raise CalibrationError for camera folders that can't be used, before detection takes minutes."""
    names = sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    if unknown := [name for name in names if name not in rig.cameras]:
        raise CalibrationError(
            f"camera '{unknown[0]}' of {folder} is not in the rig, which has {', '.join(sorted(rig.cameras))}; rename "
            f"the folder, or run python -m calib intrinsics --camera {unknown[0]}"
        )
    if len(names) == 1:
        raise CalibrationError(f"{folder} holds one camera, '{names[0]}'; triangulation needs two or more")
