# SPDX-License-Identifier: BSD-3-Clause
"""A camera that repeats its last image is recognized by identical detections of robots that moved."""

from dataclasses import replace

import numpy as np
import pytest

from fusion.model.frames import CalibratedFrame
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import Tracker
from tests.fusion.synthetic import PERIOD_NS, TRIANGLE, WIDE, Arena, line
from tests.fusion.tracks import errors

FROZEN, THAWED = 30, 60  # frames of each camera, between which cam1 repeats its image
ROBOTS = {"a": TRIANGLE, "b": WIDE}
STILL = {"a": line((-0.5, 0.3, 0.15)), "b": line((0.5, -0.3, 0.5))}
MOVING = {
    "a": line((-0.5, 0.3, 0.15), (0.25, -0.1, 0), turn=(0, 0, 0.5)),
    "b": line((0.5, -0.3, 0.5), (-0.2, 0.15, 0), turn=(0, 0, -0.4)),
}


def frozen(frames: list[CalibratedFrame]) -> list[CalibratedFrame]:
    """The frames with the same image of cam1 between `FROZEN` and `THAWED`."""
    own = [k for k, frame in enumerate(frames) if frame.camera == "cam1"]
    changed = list(frames)
    for k in own[FROZEN:THAWED]:
        shown = frames[own[FROZEN]]
        changed[k] = replace(shown, t_ns=frames[k].t_ns)
    return changed


def run(arena: Arena, frames: list[CalibratedFrame]):
    """Track the frames that are admitted; returns the poses, and the time (s) of each refused frame by camera."""
    tracker, synchronizer = Tracker(arena.cameras, ROBOTS), FrameSynchronizer(PERIOD_NS)
    poses, refused, corrections = [], [], []
    for frame in frames:
        admitted = tracker.admit(replace(frame, received_ns=frame.t_ns))
        if admitted is None:
            synchronizer.ignore(frame.camera)
            refused.append((frame.camera, arena.seconds(frame.t_ns)))
        else:
            synchronizer.add(admitted)
        for frame_set in synchronizer.take(frame.t_ns):
            result = tracker.track(frame_set)
            poses += result.poses
            corrections += tracker.check_extrinsics(frame_set)
    assert corrections == []
    return poses, refused


@pytest.mark.parametrize("sigma_px", [0.1, pytest.param(0.0, marks=pytest.mark.ci)])
def test_a_frozen_image_is_excluded_while_it_lasts(sigma_px, caplog):
    """Robots move by 1.5 px in 0.05 s; until then the old image is right to as much. 1.5 px are 9 mm."""
    arena = Arena(ROBOTS, MOVING, sigma_px=sigma_px)
    frames = frozen(arena.frames(90))
    own = [arena.seconds(f.t_ns) for f in frames if f.camera == "cam1"]
    poses, refused = run(arena, frames)
    assert {name for name, _ in refused} == {"cam1"}
    first_s, last_s = refused[0][1], refused[-1][1]
    assert own[FROZEN] < first_s < own[FROZEN] + 0.15
    assert last_s == own[THAWED - 1]
    assert caplog.text.count("cam1 repeats its image") == 1
    for robot in ROBOTS:
        mine = [pose for pose in poses if pose.robot == robot][3:]
        assert all(pose.state == "tracked" for pose in mine)
        assert np.linalg.norm(errors(arena, mine)[:, 3:], axis=1).max() < 2e-3


def test_a_scene_at_rest_is_not_frozen():
    """Images without noise repeat exactly."""
    arena = Arena(ROBOTS, STILL)
    poses, refused = run(arena, arena.frames(60))
    assert refused == []
    assert all(pose.state == "tracked" for pose in poses[6:])


def test_a_camera_that_sees_only_a_robot_at_rest_is_not_frozen():
    """Without noise, while another robot moves in the images of the other cameras."""
    still = {"a": STILL["a"], "b": MOVING["b"]}
    both, alone = Arena(ROBOTS, still), Arena({"a": TRIANGLE}, {"a": still["a"]})
    of_alone = iter([frame for frame in alone.frames(60) if frame.camera == "cam1"])
    frames = [next(of_alone) if frame.camera == "cam1" else frame for frame in both.frames(60)]
    _, refused = run(both, frames)
    assert refused == []
