# SPDX-License-Identifier: BSD-3-Clause
"""`roundel run`: frames or observations into `poses.csv`."""

from pathlib import Path

from calib.rig.rig import load_rig
from camera_node.foundation.terminal import say, track
from fusion.export.pose_formats import require_own_format, write_csv
from fusion.model.robots import load_robots
from fusion.recordings.offline_fusion import OfflineArena, Summary, fuse_recording, read_detections


def run(
    *,
    rig: Path,
    robots: Path,
    out: Path,
    frames: Path | None = None,
    observations: Path | None = None,
    rate_hz: float | None = None,
    smooth: bool = False,
) -> int:
    """Estimate the robots' poses in every frame set of recorded frames or observations.

    Args:
        rig: rig.yaml with the cameras' poses.
        robots: robots.yaml.
        out: poses.csv to write.
        frames: a folder of <camera>/<t_ns>.png or .jpg.
        observations: an observations.csv instead of frames.
        rate_hz: poses a second; without it the rate of the fastest camera.
        smooth: estimate each pose from later frames, too, not only from those before it.
    """
    require_own_format(out, ".csv")
    cameras = load_rig(rig).require_placed(rig)
    arena = OfflineArena(cameras, load_robots(robots), rate_hz, smooth=smooth)
    messages, summary = read_detections(frames, observations, cameras), Summary()
    fused = track(fuse_recording(messages, arena, summary), "fusing")
    write_csv((pose for frame_set in fused for pose in frame_set.poses), out)
    for line in (*summary.lines(arena.robots), f"wrote {out}"):
        say(line)
    return 0
