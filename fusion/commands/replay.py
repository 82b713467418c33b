# SPDX-License-Identifier: BSD-3-Clause
"""`roundel replay`: a recording (MCAP) into `poses.csv` or another recording."""

from pathlib import Path

from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say, track
from fusion.export.pose_formats import require_own_format, write_csv
from fusion.model.limits import Limits
from fusion.model.robots import load_robots
from fusion.recordings.arena_recording import read_recording
from fusion.recordings.offline_fusion import (
    OfflineArena,
    Summary,
    cameras_of,
    fuse_again,
    require_held,
    write_recording,
)


def replay(
    recording: Path,
    /,
    *,
    out: Path,
    rig: Path | None = None,
    robots: Path | None = None,
    rate_hz: float | None = None,
    smooth: bool = False,
) -> int:
    """Fuse a recording (MCAP) again, by the code that runs live: the poses are those of the server, byte for byte.

    With another rig or rate, and in recordings without a server, frame sets are formed again from the times of arrival.

    Args:
        recording: the MCAP file.
        out: the file to write: poses.csv, or .mcap with the same detections and new poses and markers.
        rig: a rig.yaml instead of the recorded one.
        robots: a robots.yaml instead of the recorded one.
        rate_hz: poses a second; without it the rate of the fastest camera.
        smooth: estimate each pose from later frames, too, not only from those before it.
    """
    require_own_format(out, ".csv", ".mcap")
    if out.exists() and recording.exists() and out.samefile(recording):
        raise ConfigError(f"--out {out} is the recording itself; give another file, which is then replaced")
    recorded = read_recording(recording)
    require_held(recorded, recording, rig=rig or recorded.rig, robots=robots or recorded.robots)
    cameras = cameras_of(recorded, recording, rig)
    declared = load_robots(robots) if robots else recorded.robots
    arena = OfflineArena(cameras, declared, rate_hz, recorded.limits or Limits(), smooth)
    summary = Summary(faults=recorded.faults)
    forms_sets = rig is not None or rate_hz is not None
    fused = track(fuse_again(recorded, arena, summary, forms_sets), "fusing")
    if out.suffix == ".mcap":
        write_recording(recording, out, fused)
    else:
        write_csv((pose for frame_set in fused for pose in frame_set.poses), out)
    for line in (*summary.lines(arena.robots), f"wrote {out}"):
        say(line)
    return 0
