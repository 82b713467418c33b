# SPDX-License-Identifier: BSD-3-Clause
"""A bumped camera is named, set aside and placed anew; the world stays where it is."""

import msgspec
import numpy as np
import pytest

from camera_node.geometry.pose import Pose, rotation_from_vector
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import Tracker
from tests.fusion.conftest import errors
from tests.fusion.synthetic import PERIOD_NS, TRIANGLE, WIDE, Arena, line

BUMP_S = 0.7
ROBOTS = {"a": TRIANGLE, "b": WIDE}
MOTIONS = {
    "a": line((-0.5, 0.3, 0.15), (0.25, -0.1, 0), turn=(0, 0, 0.5)),
    "b": line((0.5, -0.3, 0.5), (-0.2, 0.15, 0), turn=(0, 0, -0.4)),
}


def bumped(turn_deg: float, shift_m: float) -> tuple[Arena, Arena]:
    """An arena, and the same in which cam1 was turned and shifted, about axes that are no coordinate's."""
    before = Arena(ROBOTS, MOTIONS, sigma_px=0.1)
    T = before.cameras["cam1"].matrix()
    T[:3, :3] = T[:3, :3] @ rotation_from_vector(np.radians(turn_deg) * np.array([0.6, 0.64, 0.48]))
    T[:3, 3] += shift_m * np.array([0.48, -0.6, 0.64])
    cameras = dict(before.cameras)
    cameras["cam1"] = msgspec.structs.replace(cameras["cam1"], T_world_cam=Pose.from_matrix(T))
    return before, Arena(ROBOTS, MOTIONS, cameras=cameras, sigma_px=0.1)


@pytest.mark.parametrize(("turn_deg", "shift_m"), [(2.0, 0.0), (0.0, 0.02), (-2.0, 0.02)])
def test_a_bumped_camera_is_named_within_a_second_and_healed(turn_deg, shift_m):
    """Poses meanwhile within 2 mm. What some 300 roundels within 1 m tell of a camera 4 m away: its place to 6 mm,
    and, since a turn makes up for it, where it looks to 0.5 px in the arena's middle."""
    before, after = bumped(turn_deg, shift_m)
    frames = [f for f in before.frames(110) if before.seconds(f.t_ns) < BUMP_S]
    frames += [f for f in after.frames(110) if before.seconds(f.t_ns) >= BUMP_S]
    tracker, instants, named, healed, poses = (
        Tracker(before.cameras, ROBOTS),
        FrameSynchronizer(PERIOD_NS),
        [],
        [],
        [],
    )
    for frame in frames:
        instants.add(frame)
        for instant in instants.take(frame.t_ns):
            result = tracker.track(instant)
            poses += result.poses
            for move in tracker.check_extrinsics(instant, result):
                (named if move.camera is None else healed).append((move.name, before.seconds(instant.t_ns)))
    assert [name for name, _ in named] == ["cam1"] == [name for name, _ in healed]
    assert named[0][1] - BUMP_S < 1.0
    assert healed[0][1] - BUMP_S < 3.5
    T, truth = tracker.cameras["cam1"].matrix(), after.cameras["cam1"].matrix()
    assert np.linalg.norm(T[:3, 3] - truth[:3, 3]) < 6e-3
    middle = [[0.0, 0.0, 0.3]]
    looks = [c.project_world(middle) for c in (tracker.cameras["cam1"], after.cameras["cam1"])]
    assert np.linalg.norm(looks[0] - looks[1]) < 0.5
    for robot in ROBOTS:
        mine = [pose for pose in poses if pose.robot == robot][3:]
        assert all(pose.state == "tracked" for pose in mine)
        assert np.linalg.norm(errors(before, mine)[:, 3:], axis=1).max() < 2e-3


def around(t: float) -> tuple[np.ndarray, np.ndarray]:
    """R and p of a robot that wanders through the arena, turning."""
    return rotation_from_vector([0, 0, t]), np.array([0.7 * np.sin(0.7 * t), 0.6 * np.cos(0.5 * t), 0.2])


@pytest.mark.parametrize(("off_m", "said"), [(0.02, True), (0.0, False)])
def test_a_marker_that_was_moved_is_said_of_its_robot_and_of_no_camera(off_m, said, caplog):
    """The only robot before four cameras: 2 cm are 3 px, of which a fit of three markers leaves half."""
    (x, y, z), *others = TRIANGLE.markers
    glued = msgspec.structs.replace(TRIANGLE, markers=((x, y + off_m, z), *others))
    arena = Arena({"a": glued}, {"a": around}, sigma_px=0.1)
    tracker, instants, moves = Tracker(arena.cameras, {"a": TRIANGLE}), FrameSynchronizer(PERIOD_NS), []
    for frame in arena.frames(80):
        instants.add(frame)
        for instant in instants.take(frame.t_ns):
            moves += tracker.check_extrinsics(instant, tracker.track(instant))
    assert moves == []
    assert (list(tracker.geometry.misfits()) == ["a"]) == said
    assert ("robot a" in caplog.text) == said


def test_a_camera_that_stands_is_left_alone_though_others_see_more(run_arena):
    """False detections, a hidden marker and a camera that sees nothing for a while are no bump."""
    arena = Arena(
        ROBOTS, MOTIONS, sigma_px=0.1, distractors=6, hidden=lambda robot, marker, t: marker == 1 and t > 0.5
    )
    frames = [f for f in arena.frames(60) if not (f.camera == "cam2" and 0.5 < arena.seconds(f.t_ns) < 1.2)]
    tracker, instants = Tracker(arena.cameras, ROBOTS), FrameSynchronizer(PERIOD_NS)
    for frame in frames:
        instants.add(frame)
        for instant in instants.take(frame.t_ns):
            assert tracker.check_extrinsics(instant, tracker.track(instant)) == ()
