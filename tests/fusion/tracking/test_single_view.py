# SPDX-License-Identifier: BSD-3-Clause
"""Unlabeled markers that only one camera sees."""

import numpy as np
import pytest

from fusion.protocol.pose_messages import Markers
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import Tracker
from tests.fusion.synthetic import SINGLE, TRIANGLE, Arena, line

AXIS_PX = 0.25  # noise of a measured axis that fusion assumes


def markers_of(arena: Arena, n: int, cameras: str, later: str = "", seconds: float = np.inf) -> list[Markers]:
    """The markers in n frames of `cameras` and, after `seconds`, also of `later`; no robot is present."""
    tracker, synchronizer = Tracker(arena.cameras, {"other": TRIANGLE}), FrameSynchronizer(33_333_333)
    for frame in arena.frames(n):
        if frame.camera in cameras or (frame.camera in later and arena.seconds(frame.t_ns) > seconds):
            synchronizer.add(frame)
    return [tracker.track(frame_set).markers for frame_set in synchronizer.finish()]


@pytest.mark.ci
def test_position_errors_match_their_covariance_and_one_candidate_is_the_normal():
    """Squared Mahalanobis errors follow chi-square with 3 degrees of freedom: the mean of 40 runs is below
    3 + 4 sqrt(6 / 40). The noise floor exceeds the noise of the centres, so the lower bound is that of the range alone,
    with one degree: 1 - 4 sqrt(2 / 40). A normal at 30 degrees changes by 2.5 degrees per sigma of a 40 px axis."""
    squares, off = [], []
    for seed in range(40):
        motion = line((0.3, 0.2, 0.3), velocity=(0.4, -0.3, 0.0), tilt=(0.3, -0.2, 0.0))
        arena = Arena({"x": SINGLE}, {"x": motion}, sigma_px=AXIS_PX, seed=seed)
        last = markers_of(arena, 8, "cam0")[-1]
        R, p = motion(arena.seconds(last.t_ns))
        assert last.robot_index().tolist() == [-1]
        assert last.camera_bits().tolist() == [1]
        P = np.frombuffer(last.covariance, "<f4").reshape(3, 3).astype(float)
        e = last.positions()[0] - p
        squares.append(e @ np.linalg.solve(P, e))
        off.append(np.degrees(np.arccos(np.max(last.normal_candidates()[0] @ R[:, 2]))))
        assert np.isnan(last.normals()).all()
    assert 1 - 4 * np.sqrt(2 / 40) < np.mean(squares) < 3 + 4 * np.sqrt(6 / 40)
    assert np.median(off) < 5


def test_a_marker_is_reported_once_when_a_second_camera_joins():
    arena = Arena({"x": SINGLE}, {"x": line((0.3, 0.2, 0.3), velocity=(0.8, -0.4, 0.0))}, sigma_px=0.1)
    reported = markers_of(arena, 24, "cam0", "cam1", 0.4)
    assert [len(markers) for markers in reported[3:]] == [1] * (len(reported) - 3)
    seen_by = [markers.camera_bits()[0] for markers in reported[3:]]
    assert seen_by[0] == 1
    assert seen_by[-1] == 3


def test_false_detections_are_not_reported():
    """Eight per frame at random positions: two consecutive coincidences occur once in 10,000 frames."""
    arena = Arena({"x": SINGLE}, {"x": line((9.0, 9.0, 0.3))}, distractors=8)
    assert not sum(len(markers) for markers in markers_of(arena, 40, "cam0"))


@pytest.mark.parametrize("cameras", ["cam0", "cam0 cam1 cam2 cam3"])
def test_markers_of_a_tracked_robot_are_never_unlabeled(cameras: str):
    """A camera sees one of three markers of a tracked robot outside its gate for a while."""
    arena = Arena({"other": TRIANGLE}, {"other": line((0.1, 0.0, 0.2))}, sigma_px=0.1)
    tracker, synchronizer = Tracker(arena.cameras, arena.robots), FrameSynchronizer(33_333_333)
    for frame in arena.frames(20):
        if arena.seconds(frame.t_ns) < 0.3 or frame.camera in cameras:
            synchronizer.add(frame)
    results = [tracker.track(frame_set) for frame_set in synchronizer.finish()]
    assert all((result.markers.robot_index() >= 0).all() for result in results[1:])
