# SPDX-License-Identifier: BSD-3-Clause
"""The frame sets of a recording as the server formed them, so that a replay repeats the server's poses exactly.

Which frames form a set depends on when they arrived at the server, and a recorder does not know that.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

from calib.rig.camera import Camera
from camera_node.protocol.messages import Detections
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.protocol.pose_messages import FusedFrames
from fusion.recordings.arena_recording import ArenaRecording
from fusion.server.ingest import sanitized


def recorded_frame_sets(
    recording: ArenaRecording, cameras: dict[str, Camera], faults: Counter[str]
) -> Iterator[FrameSet]:
    """Yield the server's frame sets from the first one of which all frames were recorded.

    Args:
        recording: of the server and its cameras.
        cameras: the placed ones, with the poses that the server used.
        faults: counts frames that the server used and the recording does not hold.
    """
    messages: dict[tuple[str, int], Detections] = {}
    for _, message in recording.detections:
        messages.setdefault((message.camera, message.t_ns), message)  # the server refuses duplicates, too
    has_begun = False
    for fused in recording.frame_sets:
        frames = tuple(_frames(fused, messages, cameras))
        n_missing = len(fused.cameras) - len(frames)
        has_begun = has_begun or (len(frames) > 0 and not n_missing)
        if has_begun:
            if n_missing:
                faults["frames that the server used and the recording does not hold"] += n_missing
            yield FrameSet(fused.t_ns, frames)


def _frames(
    fused: FusedFrames, messages: dict[tuple[str, int], Detections], cameras: dict[str, Camera]
) -> Iterator[CalibratedFrame]:
    for name, stamp_ns, t_ns, clock_sigma_s in fused.rows():
        message, camera = messages.get((name, stamp_ns)), cameras.get(name)
        if message is not None and camera is not None:
            frame = sanitized(CalibratedFrame.of(message, camera))
            yield replace(frame, t_ns=t_ns, clock_sigma_s=clock_sigma_s)
