# SPDX-License-Identifier: BSD-3-Clause
"""A moved camera is found, excluded and recalibrated; the world frame does not change."""

import numpy as np
import pytest

from fusion.model.frames import FrameSet
from fusion.monitoring.clocks.time_search import Snapshot
from fusion.monitoring.extrinsics_monitor import ExtrinsicsCorrection
from fusion.protocol.pose_messages import RobotPose
from fusion.rig_graph.rig_monitor import RigMonitor
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import Tracker
from tests.fusion.moved_camera import MOTIONS, MOVE_S, ROBOTS, black, moved
from tests.fusion.synthetic import PERIOD_NS, Arena
from tests.fusion.tracks import errors


class JudgedTracker:
    """A tracker that leaves out the frames of excluded cameras, and uses the poses that its monitor decides."""

    def __init__(self, arena: Arena) -> None:
        self.tracker = tracker = Tracker(arena.cameras, ROBOTS)
        densities = tracker.estimator.densities
        floor_px = tracker.limits.sigma_floor_px
        self.monitor = RigMonitor(tracker.cameras, tracker.table.markers, densities, floor_px)

    def track(self, frame_set: FrameSet) -> tuple[tuple[RobotPose, ...], tuple[ExtrinsicsCorrection, ...]]:
        used = tuple(frame for frame in frame_set.frames if frame.camera not in self.monitor.excluded)
        result = self.tracker.track(FrameSet(frame_set.t_ns, used))
        now = Snapshot(frame_set.t_ns, self.tracker.table.states, self.tracker.table.tracked)
        corrections = self.monitor.check(frame_set, now, True)
        for correction in corrections:
            if correction.camera is not None:
                self.tracker.cameras.place(correction.name, correction.camera)
        return tuple(result.poses), corrections


@pytest.mark.parametrize(
    ("turn_deg", "shift_m"), [(2.0, 0.0), pytest.param(0.0, 0.02, marks=pytest.mark.slow), (-2.0, 0.02)]
)
def test_a_moved_camera_is_excluded_within_a_second_and_recalibrated(turn_deg, shift_m):
    """Poses stay within 2 mm. About 300 roundels within 1 m determine the position of a camera 4 m away to 6 mm;
    since its rotation compensates for that, it projects the centre of the arena to within 0.5 px."""
    before, after = moved(turn_deg, shift_m)
    frames = [f for f in before.frames(110) if before.seconds(f.t_ns) < MOVE_S]
    frames += [f for f in after.frames(110) if before.seconds(f.t_ns) >= MOVE_S]
    judged, synchronizer = JudgedTracker(before), FrameSynchronizer(PERIOD_NS)
    excluded, recalibrated, poses = [], [], []
    for frame in frames:
        synchronizer.add(frame)
        for frame_set in synchronizer.take(frame.t_ns):
            found, corrections = judged.track(frame_set)
            poses += found
            for correction in corrections:
                (excluded if correction.camera is None else recalibrated).append(
                    (correction.name, before.seconds(frame_set.t_ns))
                )
    assert [name for name, _ in excluded] == ["cam1"] == [name for name, _ in recalibrated]
    assert excluded[0][1] - MOVE_S < 1.0
    assert recalibrated[0][1] - MOVE_S < 3.5
    tracker = judged.tracker
    T, truth = tracker.cameras["cam1"].matrix(), after.cameras["cam1"].matrix()
    assert np.linalg.norm(T[:3, 3] - truth[:3, 3]) < 6e-3
    middle = [[0.0, 0.0, 0.3]]
    looks = [c.project_world(middle) for c in (tracker.cameras["cam1"], after.cameras["cam1"])]
    assert np.linalg.norm(looks[0] - looks[1]) < 0.5
    for robot in ROBOTS:
        mine = [pose for pose in poses if pose.robot == robot][3:]
        assert all(pose.state == "tracked" for pose in mine)
        assert np.linalg.norm(errors(before, mine)[:, 3:], axis=1).max() < 2e-3


def test_a_correct_camera_is_not_excluded():
    """Despite false detections, a hidden marker, a camera without frames for a while, and one whose frames turn black:
    what it saw besides the markers before does not stand for them."""
    arena = Arena(
        ROBOTS, MOTIONS, sigma_px=0.1, distractors=8, hidden=lambda robot, marker, t: marker == 1 and t > 0.5
    )
    frames = [f for f in arena.frames(60) if not (f.camera == "cam2" and 0.5 < arena.seconds(f.t_ns) < 1.2)]
    frames = [black(f) if f.camera == "cam1" and arena.seconds(f.t_ns) > 1.2 else f for f in frames]
    judged, synchronizer = JudgedTracker(arena), FrameSynchronizer(PERIOD_NS)
    for frame in frames:
        synchronizer.add(frame)
        for frame_set in synchronizer.take(frame.t_ns):
            assert judged.track(frame_set)[1] == ()
