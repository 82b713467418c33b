# SPDX-License-Identifier: BSD-3-Clause
"""What the pipeline keeps when its tracker is replaced."""

from pathlib import Path

import msgspec

from calib.rig.rig import Rig
from fusion.model.frames import CalibratedFrame
from fusion.server.pipeline import TrackingPipeline
from tests.fusion.serving import ARENA, config

JUMP_NS, LAG_NS = 500_000_000, 10_000_000


def with_a_clock_that_jumped(pipeline: TrackingPipeline) -> None:
    """Track frames, and let one camera's stamps jump after half of them; its arrivals show it."""
    for message in sorted(ARENA.messages(60), key=lambda m: m.t_ns):
        is_wrong = message.camera == "cam0" and message.seq > 120
        stamped = msgspec.structs.replace(message, t_ns=message.t_ns + is_wrong * JUMP_NS)
        frame = CalibratedFrame.of(stamped, ARENA.cameras[message.camera], message.t_ns + LAG_NS)
        admitted = pipeline.admit(frame)
        if admitted is not None:
            pipeline.synchronizer.add(admitted)
        for frame_set in pipeline.synchronizer.take(message.t_ns + LAG_NS):
            assert pipeline.tracker is not None
            pipeline.tracker.track(frame_set)


def test_a_restart_of_tracking_keeps_the_corrections_of_clocks(tmp_path: Path):
    """Before: every frame set without a solution made the stamps of a corrected camera wrong again."""
    pipeline = TrackingPipeline(config(tmp_path))
    with_a_clock_that_jumped(pipeline)
    before = pipeline.status().clocks
    assert before["cam0"].state != "correct"
    pipeline.restart()
    assert pipeline.status().clocks == before


def test_a_rig_with_another_camera_without_a_pose_changes_no_track(tmp_path: Path):
    pipeline = TrackingPipeline(config(tmp_path))
    tracker = pipeline.tracker
    unplaced = msgspec.structs.replace(ARENA.cameras["cam0"], T_world_cam=None)
    pipeline.replace_rig(Rig(cameras={**ARENA.cameras, "new": unplaced}), 1)
    assert pipeline.tracker is tracker
