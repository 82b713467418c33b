# SPDX-License-Identifier: BSD-3-Clause
"""Recordings as the subcommands take them: frames, observations or messages of a rig's cameras."""

from pathlib import Path

from calib.errors import CalibrationError
from calib.rig.recording import read_wave
from calib.rig.rig import Rig
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from camera_node.sources.observations import detect_frames, read_observations


def read_recording(
    rig: Rig,
    frames: Path | None,
    observations: Path | None,
    body: Body | None = None,
    recording: Path | None = None,
) -> list[Detections]:
    """The detections of a folder of frames, a CSV or an MCAP file, that was recorded with the cameras of a rig.

    Raises:
        ConfigError, CameraError, CalibrationError: nothing usable is there, or a camera is not of the rig.
    """
    if frames is not None:
        _check_folders(frames, rig)
        return detect_frames(frames, **({"inner_ratios": (body.inner_ratio,)} if body else {}))
    if recording is not None:
        return read_wave(recording)
    assert observations is not None
    sizes = {name: (lens.width, lens.height) for name, lens in rig.cameras.items()}
    return read_observations(observations, sizes)


def _check_folders(folder: Path, rig: Rig) -> None:
    """Say before the minutes of detection what would be said after them."""
    names = sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    if unknown := [name for name in names if name not in rig.cameras]:
        raise CalibrationError(
            f"{folder / unknown[0]} is no camera of the rig, which has {', '.join(sorted(rig.cameras))}; rename "
            f"the folder, or run python -m calib intrinsics --camera {unknown[0]}"
        )
    if len(names) == 1:
        raise CalibrationError(
            f"{folder} holds one camera, '{names[0]}'; two or more are needed to see depth"
        )
