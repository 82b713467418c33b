# SPDX-License-Identifier: BSD-3-Clause
"""Markers of nobody before one camera alone."""

import numpy as np
import pytest

from fusion.protocol.messages import Markers
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import Tracker
from tests.fusion.synthetic import SINGLE, TRIANGLE, Arena, line

AXIS_PX = 0.25  # what fusion takes a measured axis to be off by


def told(arena: Arena, n: int, cameras: str, later: str = "", seconds: float = np.inf) -> list[Markers]:
    """The markers of n frames of these cameras, and after some seconds of the later ones too; no robot is there."""
    tracker, instants = Tracker(arena.cameras, {"other": TRIANGLE}), FrameSynchronizer(33_333_333)
    for frame in arena.frames(n):
        if frame.camera in cameras or (frame.camera in later and arena.seconds(frame.t_ns) > seconds):
            instants.add(frame)
    return [tracker.track(instant).markers for instant in instants.finish()]


def test_its_place_is_as_good_as_its_covariance_says_and_one_candidate_is_its_normal():
    """Squared Mahalanobis errors follow chi-square with 3 degrees, the mean of 40 runs being 3 +- 4 sqrt(6 / 40), and
    1 mm^2 for each: the detection's centre is better known than the floor says, hence no lower bound but that of the
    range alone, one degree: 1 - 4 sqrt(2 / 40). A normal at 30 degrees moves by 2.5 degrees a sigma of a 40 px axis."""
    squares, off = [], []
    for seed in range(40):
        motion = line((0.3, 0.2, 0.3), velocity=(0.4, -0.3, 0.0), tilt=(0.3, -0.2, 0.0))
        arena = Arena({"x": SINGLE}, {"x": motion}, sigma_px=AXIS_PX, seed=seed)
        last = told(arena, 8, "cam0")[-1]
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


def test_no_marker_is_told_twice_when_a_second_camera_joins():
    arena = Arena({"x": SINGLE}, {"x": line((0.3, 0.2, 0.3), velocity=(0.8, -0.4, 0.0))}, sigma_px=0.1)
    instants = told(arena, 24, "cam0", "cam1", 0.4)
    assert [len(markers) for markers in instants[3:]] == [1] * (len(instants) - 3)
    seen_by = [markers.camera_bits()[0] for markers in instants[3:]]
    assert seen_by[0] == 1
    assert seen_by[-1] == 3


def test_false_detections_are_not_told():
    """Eight a frame, anywhere: two that come next to each other twice in a row are one in 10,000 frames."""
    arena = Arena({"x": SINGLE}, {"x": line((9.0, 9.0, 0.3))}, distractors=8)
    assert not sum(len(markers) for markers in told(arena, 40, "cam0"))


@pytest.mark.parametrize("cameras", ["cam0", "cam0 cam1 cam2 cam3"])
def test_a_robots_own_markers_are_nobodys_to_no_camera(cameras: str):
    """Three markers of a followed robot, one of which a camera sees beside its gate for a while."""
    arena = Arena({"other": TRIANGLE}, {"other": line((0.1, 0.0, 0.2))}, sigma_px=0.1)
    tracker, instants = Tracker(arena.cameras, arena.robots), FrameSynchronizer(33_333_333)
    for frame in arena.frames(20):
        if arena.seconds(frame.t_ns) < 0.3 or frame.camera in cameras:
            instants.add(frame)
    fused = [tracker.track(instant) for instant in instants.finish()]
    assert all((instant.markers.robot_index() >= 0).all() for instant in fused[1:])
