# SPDX-License-Identifier: BSD-3-Clause
"""The markers of an undeclared robot are measured, and make a robot that is tracked."""

import msgspec
import numpy as np
import pytest

from camera_node.geometry.pose import rotation_from_vector, rotation_from_wxyz
from fusion.client.robot_definition import StationaryMarkers, find_stationary_markers, robot_from_markers
from fusion.errors import FusionError
from fusion.model.likeness import distances
from fusion.model.robots import Robot, load_robots, require_distinct
from fusion.protocol.pose_messages import Markers
from tests.conftest import ROOT
from tests.fusion.synthetic import EQUILATERAL, SINGLE, TRIANGLE, WIDE, Arena, line, ring
from tests.fusion.tracks import track
from tests.fusion.unknown_robot import WIDE_MOTION

pytestmark = pytest.mark.computed
CUBE = load_robots(ROOT / "configs" / "robots_cube.yaml")["cube"]
SIMILAR = Robot(diameter_m=CUBE.diameter_m, markers=TRIANGLE.markers)
LARGE = Robot(diameter_m=CUBE.diameter_m, markers=((0.3, 0.0, 0.0), (-0.3, 0.1, 0.0), (0.0, -0.4, 0.0)))
UNKNOWN = np.full((3, 3), np.nan)


def plain(points: np.ndarray, normals: np.ndarray) -> StationaryMarkers:
    """Markers without codes and sizes."""
    return StationaryMarkers(
        points,
        normals,
        np.full(len(points), np.nan),
        np.zeros(len(points), int),
        np.full_like(points, np.nan),
    )


def markers_of(arena: Arena, n: int = 30, declared: Robot = TRIANGLE) -> list[Markers]:
    """The markers of a tracker that knows only another robot, which is not there."""
    known = Arena({"a": declared}, {"a": line((0, 0, 0))}, arena.cameras)
    return [fused.markers for fused in track(known, arena.frames(n))]


def test_the_measured_robot_has_the_true_distances():
    """0.1 px is at most 0.6 mm for a marker in one frame set here, and the median of 30 has 1.25 / sqrt(30) of that:
    5 sigma and the rounding are 1 mm. Origin, z and x of the body's frame are as documented."""
    markers = find_stationary_markers(markers_of(Arena({"b": WIDE}, {"b": WIDE_MOTION}, sigma_px=0.1)))
    robot = robot_from_markers(markers, WIDE.diameter_m)
    R, p = WIDE_MOTION(0.0)
    true = p + WIDE.points @ R.T
    order = [int(np.argmin(np.linalg.norm(true - q, axis=1))) for q in markers.position]
    assert sorted(order) == [0, 1, 2]
    assert np.abs(distances(robot.points) - distances(WIDE.points[order])).max() < 1e-3
    assert np.abs(robot.points.mean(0)).max() < 1e-4, "rounded to a tenth of a millimetre"
    assert robot.points[0, 0] > 0.1
    assert np.abs(robot.points[0, 1:]).max() < 1e-3
    require_distinct({"a": TRIANGLE, "b": robot})


def test_a_measured_robot_is_tracked_at_its_true_pose():
    """The position is the markers' mean and z their normal, within 1 mm and 1 mm / 0.2 m."""
    arena = Arena({"b": WIDE}, {"b": WIDE_MOTION}, sigma_px=0.1)
    measured = {"b": robot_from_markers(find_stationary_markers(markers_of(arena)), WIDE.diameter_m)}
    pose = track(Arena(measured, arena.motions, arena.cameras), arena.frames(20))[-1].poses[0]
    R, p = WIDE_MOTION(0.0)
    assert pose.state == "tracked"
    assert np.linalg.norm(pose.position - (p + R @ WIDE.points.mean(0))) < 1e-3
    assert R[:, 2] @ rotation_from_wxyz(pose.quaternion_wxyz)[:, 2] > np.cos(1e-3 / 0.2)


def test_only_markers_that_are_stationary_and_seen_often_are_measured():
    """Of a robot that drives, one that creeps (25 mm in the second), one that is hidden for most of it, and a
    stationary one, only the last is measured."""
    robots = {"moves": SINGLE, "creeps": SINGLE, "hides": SINGLE, "stands": SINGLE}
    motions = {
        "moves": line((0.5, 0.0, 0.2), (0.3, 0.0, 0.0)),
        "creeps": line((0.0, 0.6, 0.2), (0.025, 0.0, 0.0)),
        "hides": line((0.0, -0.6, 0.2)),
        "stands": line((-0.5, 0.3, 0.2)),
    }
    arena = Arena(robots, motions, sigma_px=0.1, hidden=lambda name, marker, t: name == "hides" and t > 0.3)
    markers = find_stationary_markers(markers_of(arena))
    assert np.abs(markers.position - [[-0.5, 0.3, 0.2]]).max() < 2e-3
    assert len(markers.within((-0.5, 0.3, 0.2), 0.1).position) == 1
    assert len(markers.within((0.5, 0.3, 0.2), 0.1).position) == 0


def test_a_robot_that_is_lost_for_moments_is_no_new_one():
    """The server lost robot a in two thirds of the messages: only the markers of the other are new."""
    motions = {"a": line((0.6, -0.5, 0.2)), "b": WIDE_MOTION}
    arena = Arena({"a": TRIANGLE, "b": WIDE}, motions, sigma_px=0.05)
    lost = markers_of(arena, 20, LARGE)
    known = Arena({"a": TRIANGLE}, {"a": motions["a"]}, arena.cameras)
    found = [fused.markers for fused in track(known, arena.frames(30))][-10:]
    assert len(find_stationary_markers(lost).position) == 6
    assert all((message.robot_index() >= 0).sum() == 3 for message in found)
    assert len(find_stationary_markers([*lost, *found]).position) == 3


@pytest.mark.parametrize(
    ("phases", "declared"),
    [((0.0,) * 8, LARGE), ((0.0, 0.27, -0.41, 0.38, 0.1, -0.2, 0.45, -0.33), SIMILAR)],
    ids=["exposed at once", "free-running"],
)
def test_a_measured_cube_has_the_normals_of_its_sides_and_is_tracked(
    phases: tuple[float, ...], declared: Robot
):
    """Five sides are visible to eight cameras around it, each to three or more, exposed at once or free-running: then
    a marker could move by 60 mm between frames, and a third of the markers was found. A declared robot that is not
    there, and to whose distances three markers of three sides are similar, took these three. Planes of three markers
    within 1 mm of noise over 80 mm are within 2 degrees. z is out of the uppermost side."""
    R, p = rotation_from_vector([0.15, 0.1, 0.3]), np.array([0.0, 0.0, 0.6])
    cameras = {f"low{k}": camera for k, camera in enumerate(ring(8, height_m=1.6).values())}
    arena = Arena({"c": CUBE}, {"c": lambda t: (R, p)}, cameras, phases, sigma_px=0.1, min_facing=0.2)
    markers = find_stationary_markers(markers_of(arena, 15, declared))
    robot = robot_from_markers(markers, CUBE.diameter_m)
    true = p + CUBE.points @ R.T
    order = [int(np.argmin(np.linalg.norm(true - q, axis=1))) for q in markers.position]
    assert len(set(order)) == len(order) >= 15
    assert np.abs(distances(robot.points) - distances(CUBE.points[order])).max() < 2e-3
    found, wanted = (body @ body.T for body in (robot.unit_normals, CUBE.unit_normals[order]))
    assert np.abs(np.arccos(np.clip(found, -1, 1)) - np.arccos(np.clip(wanted, -1, 1))).max() < np.radians(4)
    assert robot.unit_normals[np.argmax(robot.unit_normals[:, 2])] == pytest.approx([0, 0, 1], abs=1e-3)
    tracked = track(Arena({"c": robot}, arena.motions, cameras), arena.frames(10))[-1].poses
    assert [pose.state for pose in tracked] == ["tracked"]


@pytest.mark.parametrize(
    ("markers", "code"), [(SINGLE.markers, 7), (EQUILATERAL, (4, 0, 6))], ids=["one marker", "symmetric"]
)
def test_codes_are_measured_and_x_points_to_the_zero_of_the_first(markers: tuple, code: int | tuple):
    """The cards of a symmetric robot are turned against each other. Tracked with what was measured, its heading is that
    of the true robot, whose x axis is the zero of its first code, within 1.5 degrees for 0.3 of the code's."""
    true = Robot(diameter_m=SINGLE.diameter_m, markers=markers, code=code)
    motion = line((0.1, -0.2, 0.2), tilt=(0.0, 0.0, 2.0))
    arena = Arena({"b": true}, {"b": motion}, sigma_px=0.1, card_turn_rad=1.0)
    found = find_stationary_markers(markers_of(arena))
    R, p = motion(0.0)
    order = [int(np.argmin(np.linalg.norm(p + true.points @ R.T - q, axis=1))) for q in found.position]
    robot = robot_from_markers(found, true.diameter_m)
    assert robot.codes == tuple(true.codes[k] for k in order)
    turn = min((k for k in order if true.codes[k]), key=order.index) * arena.card_turn_rad
    wanted = R @ rotation_from_vector([0.0, 0.0, turn])
    measured = Arena({"b": robot}, {"b": motion}, arena.cameras)
    measured.frames, measured.detect = arena.frames, arena.detect  # what the true robot shows
    pose = track(measured, arena.frames(20))[-1].poses[0]
    assert pose.state == "tracked"
    x = rotation_from_wxyz(pose.quaternion_wxyz)[:, 0]
    assert np.degrees(np.arccos(x @ wanted[:, 0])) < 1.5


def test_a_side_of_unknown_normal_is_refused():
    points = np.array([[0.2, 0.0, 0.1], [-0.1, 0.1, 0.1], [-0.1, -0.1, 0.1], [0.0, 0.2, 0.0]])
    normals = np.array([[0, 0, 1.0], [0, 0, 1.0], [np.nan] * 3, [0, 1.0, 0]])
    with pytest.raises(FusionError, match="several sides, and the normals of 1 of 4 are not known: turn"):
        robot_from_markers(plain(points, normals), 0.1)


@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_z_is_up_where_no_normal_is_known(turn: float):
    """Planar markers without normals, in both orders around the plane's normal."""
    points = np.array([[0.2, 0.0, 0.1], [-0.1, 0.1 * turn, 0.1], [-0.1, -0.1 * turn, 0.1]])
    robot = robot_from_markers(plain(points, UNKNOWN), 0.1)
    centred = points - points.mean(0)
    assert np.allclose(robot.points @ [1, 0, 0], centred[:, 0], atol=1e-4), "x along the first marker"
    assert np.allclose(robot.points @ [0, 1, 0], centred[:, 1], atol=1e-4), (
        "so y by a right hand, seen from above"
    )


def test_z_is_the_mean_normal_of_markers_that_are_not_planar():
    points = np.array([[0.2, 0.0, 0.1], [-0.1, 0.1, 0.0], [-0.1, -0.1, 0.0], [0.0, 0.0, 0.2]])
    normal = np.array([0.1, 0.0, 1.0]) / np.linalg.norm([0.1, 0.0, 1.0])
    robot = robot_from_markers(plain(points, np.tile(normal, (4, 1))), 0.1)
    height = (points - points.mean(0)) @ normal
    assert np.allclose(robot.points[:, 2], height, atol=1e-4)


def test_markers_that_make_no_robot_are_refused():
    nothing = plain(np.empty((0, 3)), np.empty((0, 3)))
    with pytest.raises(FusionError, match="no stationary unlabeled marker found there; hold the robot still"):
        robot_from_markers(nothing, 0.1)
    with pytest.raises(FusionError, match=r"make no robot: .*one line"):
        robot_from_markers(plain(np.array([[0.0, 0, 0], [0.3, 0, 0], [0.6, 0, 0]]), UNKNOWN), 0.1)
    assert len(find_stationary_markers([]).position) == 0


@pytest.mark.ci
def test_a_diameter_that_differs_from_the_discs_is_refused():
    """The server would never find such a robot: it looks for discs of the declared size. Discs of any size are seen."""
    for diameter_m in (0.06, 0.12, 0.3):
        robot = msgspec.structs.replace(
            WIDE, diameter_m=diameter_m, markers=tuple((2 * WIDE.points).tolist())
        )
        arena = Arena({"b": robot}, {"b": WIDE_MOTION}, sigma_px=0.05)
        markers = find_stationary_markers(markers_of(arena))
        assert markers.diameter_m == pytest.approx([diameter_m] * 3, rel=0.07)
        assert len(robot_from_markers(markers, diameter_m).markers) == 3
        for wrong in (0.8, 1.25):
            with pytest.raises(FusionError, match=r"measure about \d+ mm, not"):
                robot_from_markers(markers, wrong * diameter_m)
