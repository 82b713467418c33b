# SPDX-License-Identifier: BSD-3-Clause
"""`roundel export`: a recording in the formats of other programs."""

from pathlib import Path

from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say
from camera_node.sources.recorded_detections import write_observations
from fusion.export.points import sample_points
from fusion.export.pose_formats import (
    FORMATS,
    Format,
    write_c3d,
    write_csv,
    write_foxglove,
    write_parquet,
    write_rerun,
    write_rosbag,
    write_trc,
    write_tum,
)
from fusion.export.recorded_poses import RecordedPoses
from fusion.recordings.arena_recording import DETECTIONS, read_recording
from fusion.recordings.recording_files import say_skipped

WRITERS = {
    "csv": write_csv,
    "parquet": write_parquet,
    "rerun": write_rerun,
    "rosbag": write_rosbag,
    "foxglove": write_foxglove,
}


def export(
    recording: Path,
    out: Path,
    /,
    *,
    format: Format | None = None,
    robots: tuple[str, ...] = (),
    rate_hz: float | None = None,
    force: bool = False,
) -> int:
    """Write the poses of a recording (MCAP) in the format of another program, or its detections as observations.csv.

    Args:
        recording: the MCAP file of roundel record or roundel replay.
        out: the file to write: .c3d, .trc, .csv, .tum, .parquet, .rrd for Rerun, or .mcap
            for Foxglove; without suffix a ROS 2 bag, a folder.
        format: the format, if the suffix does not say it; observations for the detections of all cameras.
        robots: names of the robots to write; all unless given.
        rate_hz: frames a second (C3D, TRC); the rate of the poses unless given.
        force: replace what exists.
    """
    chosen = format or FORMATS.get(out.suffix)
    if chosen is None:
        raise ConfigError(
            f"{out.name} does not say its format; end it in .c3d, .trc, .csv, .tum, .parquet, .rrd or "
            ".mcap, or give --format"
        )
    if out.exists() and not force:
        raise ConfigError(f"{out} exists; give another name, or --force to replace it")
    if chosen == "observations":
        recorded = read_recording(recording)
        write_observations(out, (message for _, message in recorded.messages(DETECTIONS)))
        say_skipped(recorded.faults)
        say(f"wrote {out}: {recorded.counts[DETECTIONS]} frames")
        return 0
    poses = RecordedPoses(recording, robots)
    files = _write(chosen, poses, out, rate_hz, force)
    say_skipped(poses.faults)
    for robot, count in sorted(poses.counts.items()):
        say(f"{count:7} poses of {robot}")
    for file in files:
        say(f"wrote {file}")
    return 0


def _write(format: Format, poses: RecordedPoses, out: Path, rate_hz: float | None, force: bool) -> list[Path]:
    """Write a file; return what was written."""
    if format == "tum":
        return write_tum(poses, out, force)
    if format in ("c3d", "trc"):
        write = write_c3d if format == "c3d" else write_trc
        write(sample_points(poses, rate_hz), out)
    else:
        WRITERS[format](poses, out)
    return [out]
