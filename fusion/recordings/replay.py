# SPDX-License-Identifier: BSD-3-Clause
"""Replays a recording (MCAP): its rig and robots, and a copy of it with new poses and markers."""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from calib.rig.camera import Camera
from calib.rig.recording import RecordingWriter, read_messages
from calib.rig.rig import load_rig
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.messages import Keys, encode
from fusion.model.robots import Robot, load_robots
from fusion.recordings.arena_recording import ArenaRecording
from fusion.tracking.result import TrackingResult


def cameras_of(recording: ArenaRecording, path: Path, rig: Path | None) -> dict[str, Camera]:
    """The placed cameras of the file `rig`, or else of the recording.

    Raises:
        ConfigError, CalibrationError: there is no rig, or it places no camera.
    """
    if rig is not None:
        return load_rig(rig).require_placed(rig)
    if recording.rig is None:
        raise ConfigError(f"{path} holds no rig; give --rig rig.yaml")
    return recording.rig.placed()


def robots_of(recording: ArenaRecording, path: Path, robots: Path | None) -> dict[str, Robot]:
    """The robots of the file `robots`, or else of the recording.

    Raises:
        ConfigError, FusionError: there are none, or they can't be tracked.
    """
    if robots is None and not recording.robots:
        raise ConfigError(f"{path} holds no robots; give --robots robots.yaml")
    return load_robots(robots) if robots else recording.robots


def write_recording(source: Path, out: Path, fused: Iterable[TrackingResult]) -> None:
    """Copy a recording with other poses and markers, which are logged at the times of their frame sets."""
    entries = [e for e in read_messages(source, Counter()) if not e[0].endswith(("/pose", "/markers"))]
    arena = next(key for key, _, _ in entries if key.endswith("/detections")).split("/")[0]
    keys = Keys(arena)
    for frame_set in fused:
        entries += [(keys.robot_pose(pose.robot), encode(pose), frame_set.t_ns) for pose in frame_set.poses]
        entries.append((keys.markers, encode(frame_set.markers), frame_set.t_ns))
    with RecordingWriter(out) as writer:
        for entry in sorted(entries, key=lambda entry: entry[2]):
            writer.put(*entry)
