# SPDX-License-Identifier: BSD-3-Clause
"""Robots with codes: identical ones are distinguished, and a single roundel has a heading."""

from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from camera_node.geometry.pose import rotation_from_wxyz, vector_from_rotation
from camera_node.protocol.messages import Detections, decode, encode
from fusion.errors import FusionError
from fusion.model.frames import CalibratedFrame
from fusion.model.robots import Robot, require_trackable
from fusion.protocol.pose_messages import RobotPose
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import Tracker
from tests.fusion.rendered_arena import RenderedArena
from tests.fusion.synthetic import EQUILATERAL, PERIOD_NS, SINGLE, TRIANGLE, Arena, line, ring

COUNT = 5
SINGLES = {name: Robot(diameter_m=0.12, code=code) for name, code in (("a", 7), ("b", 8), ("c", 70))}
FAR = np.array([50.0, 0.0, 0.0])


def poses_of(arena: Arena, tracker: Tracker, n: int) -> Iterator[list[RobotPose]]:
    """The tracked robots of each frame set, from n messages of each camera."""
    synchronizer = FrameSynchronizer(PERIOD_NS)
    for message in arena.messages(n):
        received = decode(encode(message), Detections)
        synchronizer.add(CalibratedFrame.of(received, arena.cameras[received.camera]))
    for frame_set in synchronizer.finish():
        yield [pose for pose in tracker.track(frame_set).poses if pose.state == "tracked"]


def errors(arena: Arena, pose: RobotPose) -> tuple[float, float]:
    """Of position, metres, and of heading, radians."""
    R, p = arena.truth(pose.robot, pose.t_ns)
    turned = vector_from_rotation(R.T @ rotation_from_wxyz(pose.quaternion_wxyz))
    return float(np.linalg.norm(np.array(pose.position) - p)), float(turned[2])


@pytest.mark.ci
def test_identical_robots_of_one_coded_roundel_are_tracked_with_their_headings():
    """From rendered pictures, by detectors and messages, to poses: three robots without a start, of which one turns.

    Headings are claimed with twice the sigma of the detector, so that chi-square is 1 at most.
    """
    motions = {
        "a": line((-0.5, 0.1, 0.2), (0.8, 0.0, 0.0), (0.0, 0.0, 2.0), (0.0, 0.1, 2.0)),
        "b": line((0.5, -0.1, 0.2), (-0.8, 0.0, 0.0), tilt=(0.1, 0.0, -1.0)),
        "c": line((0.0, 0.4, 0.3), tilt=(0.0, 0.0, 0.4)),
    }
    arena = RenderedArena(SINGLES, motions, ring(3))
    sets = list(poses_of(arena, Tracker(arena.cameras, SINGLES), COUNT))
    assert sum(len(poses) for poses in sets) >= 3 * (COUNT - 1)
    chi2 = []
    for pose in (pose for poses in sets for pose in poses):
        off, turned = errors(arena, pose)
        assert off < 0.02
        chi2.append(turned**2 / pose.covariance_matrix[2, 2])
        assert pose.covariance_matrix[2, 2] < np.radians(3) ** 2
    assert np.mean(chi2) < 1


@pytest.mark.parametrize("until", [0.3, 0.45])
def test_robots_that_are_exchanged_keep_their_names(until: float):
    """At once, or while they are hidden: each is tracked where the other was within 0.1 s, and no pose is 5 cm wrong.

    Frame sets around the exchange have frames of both sides of it.
    """
    places = {"a": np.array([-0.4, 0.1, 0.2]), "b": np.array([0.3, -0.2, 0.2])}

    def motion(name: str):
        def at(t: float) -> tuple[np.ndarray, np.ndarray]:
            other = places["b" if name == "a" else "a"]
            return np.eye(3), places[name] if t < 0.3 else FAR if t < until else other

        return at

    robots = {name: SINGLES[name] for name in places}
    arena, n = Arena(robots, {name: motion(name) for name in places}, sigma_px=0.05), 22
    before, after = 0, 0
    for poses in poses_of(arena, Tracker(arena.cameras, robots), n):
        for pose in poses:
            t, off = arena.seconds(pose.t_ns), errors(arena, pose)[0]
            assert off < 0.05 or 0.27 < t < until + 0.04
            before, after = before + (t < 0.27), after + (t > until + 0.1)
    assert before >= 2 * 7
    assert after == 2 * sum(k * PERIOD_NS * 1e-9 > until + 0.1 for k in range(n))


@pytest.mark.parametrize("card_turn_rad", [0.0, 2.0], ids=["aligned cards", "turned cards"])
@pytest.mark.parametrize("markers", [TRIANGLE.markers, EQUILATERAL], ids=["identical", "symmetric"])
def test_codes_tell_constellations_apart(markers: tuple, card_turn_rad: float):
    """One marker of each has a code: neither starts nor different distances are needed. Cards of further markers may be
    glued on at any turn."""
    robots = {
        "a": Robot(diameter_m=0.12, markers=markers, code=(3, 0, 0)),
        "b": Robot(diameter_m=0.12, markers=markers, code=(4, 5, 6)),
    }
    require_trackable(robots, "robots.yaml")
    motions = {
        "a": line((-0.5, 0.1, 0.2), (0.2, 0.0, 0.0), tilt=(0.05, 0.0, 2.0)),
        "b": line((0.4, 0.0, 0.3), (0.0, 0.2, 0.0), tilt=(0.0, 0.1, -1.0)),
    }
    arena = Arena(robots, motions, sigma_px=0.05, card_turn_rad=card_turn_rad)
    sets = list(poses_of(arena, Tracker(arena.cameras, robots), 8))
    assert sum(len(poses) for poses in sets) >= 2 * 7
    for pose in (pose for poses in sets[2:] for pose in poses):
        off, turned = errors(arena, pose)
        assert off < 0.01
        assert abs(turned) < np.radians(2)
        assert pose.n_markers == 3


def test_the_turn_of_cards_changes_no_pose_of_a_robot_with_several_markers():
    """Cards that a hand glued on 3 and 6 degrees off made squared errors of headings 6 times what was claimed."""
    robots = {"a": Robot(diameter_m=0.12, markers=EQUILATERAL, code=(4, 5, 6))}
    motions = {"a": line((0.4, 0.0, 0.3), (0.0, 0.2, 0.0), tilt=(0.0, 0.1, -1.0))}
    found = []
    for card_turn_rad in (0.0, 0.05):
        arena = Arena(robots, motions, sigma_px=0.05, card_turn_rad=card_turn_rad)
        poses = [pose for poses in poses_of(arena, Tracker(arena.cameras, robots), 10) for pose in poses]
        found.append([(*pose.position, *pose.quaternion_wxyz) for pose in poses])
    assert len(found[0]) >= 9
    assert np.array(found[1]) == pytest.approx(np.array(found[0]), abs=1e-9)


def test_two_named_markers_are_enough_whatever_way_their_cards_are_turned():
    robots = {"a": Robot(diameter_m=0.12, markers=EQUILATERAL, code=(3, 4, 5))}
    motions = {"a": line((-0.2, 0.1, 0.2), (0.2, 0.0, 0.0), tilt=(0.05, 0.0, 2.0))}
    arena = Arena(
        robots, motions, sigma_px=0.05, card_turn_rad=2.0, hidden=lambda name, marker, t: marker == 0
    )
    sets = list(poses_of(arena, Tracker(arena.cameras, robots), 8))
    assert sum(len(poses) for poses in sets) >= 7
    for pose in (pose for poses in sets[2:] for pose in poses):
        off, turned = errors(arena, pose)
        assert off < 0.02
        assert abs(turned) < np.radians(3)


def test_a_name_that_was_not_read_leaves_the_robot_missing():
    robots = {"a": msgspec.structs.replace(SINGLES["a"], code=9)}
    arena = Arena({"a": SINGLES["a"]}, {"a": line((0.0, 0.1, 0.2))}, sigma_px=0.05)
    tracker = Tracker(arena.cameras, robots)
    assert not any(poses_of(arena, tracker, 6))
    assert tracker.not_acquired() == {"a": "fewer than 2 cameras read a code of it"}


def test_robots_with_one_code_are_refused():
    with pytest.raises(FusionError, match="robots 'a' and 'b' have the same code 7"):
        require_trackable({"a": SINGLES["a"], "b": SINGLES["a"]}, "robots.yaml")
    with pytest.raises(FusionError, match="identical"):
        require_trackable({"a": SINGLES["a"], "b": SINGLE}, "robots.yaml")
