# SPDX-License-Identifier: BSD-3-Clause
"""A replay repeats the poses of a server whose judgements of the cameras came late, as on a busy machine."""

from dataclasses import replace

import msgspec

from camera_node.protocol.messages import decode, encode
from fusion.model.frames import FrameSet
from fusion.protocol.pose_messages import FusedFrames, RobotPose
from fusion.recordings.offline_fusion import OfflineArena, fuse_frame_sets
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import Tracker
from tests.benchmarks.faults.late_results import LateResults
from tests.fusion.moved_camera import MOVE_S, ROBOTS, moved
from tests.fusion.synthetic import PERIOD_NS, Arena

DELAY = 7  # frame sets from the start of a judgement to its result


def frame_sets(before: Arena, after: Arena) -> list[FrameSet]:
    """Of an arena in which a camera is moved."""
    synchronizer, closed = FrameSynchronizer(PERIOD_NS), []
    frames = [f for f in before.frames(75) if before.seconds(f.t_ns) < MOVE_S]
    for frame in frames + [f for f in after.frames(75) if before.seconds(f.t_ns) >= MOVE_S]:
        synchronizer.add(frame)
        closed += synchronizer.take(frame.t_ns)
    return closed


def messages(poses: list[RobotPose]) -> list[bytes]:
    return [encode(pose) for pose in poses]


def test_a_replay_takes_judgements_when_the_server_took_them():
    before, after = moved(2.0, 0.0)
    given = frame_sets(before, after)
    poses, recorded = list[RobotPose](), list[FrameSet]()
    live, late = Tracker(before.cameras, ROBOTS), LateResults(DELAY, lambda: len(recorded))
    live.monitors.rig.executor = late
    live.monitors.rig.doubt()
    for frame_set in given:
        poses += live.track(frame_set).poses
        late.release()
        live.check_extrinsics(frame_set)
        recorded.append(replace(frame_set, judged=live.monitors.rig.take_judged()))
    assert sum(frame_set.judged or 0 for frame_set in recorded) > 2
    arena = OfflineArena(before.cameras, ROBOTS)
    again, at_once = (
        messages([pose for result in fuse_frame_sets(sets, arena) for pose in result.poses])
        for sets in (recorded, given)
    )
    assert again == messages(poses)
    assert at_once != again


def test_recordings_repeat_how_well_the_times_of_frames_are_known():
    """And when they arrived, by which clocks are judged. Those of older servers state neither this nor the errors of
    single stamps."""
    (before, _), errors = (
        moved(2.0, 0.0),
        {"clock_sigma_s": 2e-3, "stamp_sigma_s": 3e-3, "received_ns": 10**18},
    )
    frames = tuple(replace(frame, **errors) for frame in before.frames(1))
    message = FusedFrames.of(FrameSet(frames[0].t_ns, frames), 0)
    for recorded, received_ns, stamp_sigma_s in (
        (message, 10**18, 3e-3),
        (msgspec.structs.replace(message, stamp_sigmas=b"", arrivals=b""), 0, 0.0),
    ):
        again = decode(encode(recorded), FusedFrames)
        again.check()
        assert again.rows() == [
            (f.camera, f.stamp_ns, f.t_ns, received_ns, 2e-3, stamp_sigma_s) for f in frames
        ]
