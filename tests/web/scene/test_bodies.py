# SPDX-License-Identifier: BSD-3-Clause
"""The bodies and prints of robots, in a real Viser server."""

import msgspec
import numpy as np
import pytest
import viser

from camera_node.foundation.arrays import Array
from camera_node.foundation.config import example_file
from camera_node.geometry.pose import rotation_from_vector, rotation_from_wxyz
from fusion.model.robots import Robot, load_robots
from fusion.protocol.pose_messages import Markers, RobotPose
from web.colours import CARD, CARD_UNSEEN
from web.scene.bodies import Mesh, box_mesh, cylinder_mesh, enclosing_part
from web.scene.robot_drawing import RobotDrawing
from web.state.feed import ArenaState, TimedMessage

CUBE = load_robots(example_file("cube/robots.yaml"))["cube"]
SIDE_M = 0.38
FLAT = load_robots(example_file("demo/robots.yaml"))["rover"]
TURN = rotation_from_vector(np.array([0.4, -0.3, 0.9]))


def turned(robot: Robot, R: Array) -> Robot:
    """The same body with another frame: a vector of the old frame has the coordinates R v in the new one."""
    markers, normals = (tuple(map(tuple, (v @ R.T).tolist())) for v in (robot.points, robot.unit_normals))
    return msgspec.structs.replace(robot, markers=markers, normals=normals)


@pytest.mark.parametrize("R", [np.eye(3), TURN])
def test_a_body_with_prints_on_all_sides_is_a_box(R: Array):
    """The box of the cube is as large as the cube, however its frame lies."""
    part = enclosing_part(turned(CUBE, R))
    assert part.is_box
    np.testing.assert_allclose(np.sort(part.size), SIDE_M, atol=0.02)  # cards end 13 mm within the edges
    np.testing.assert_allclose(part.R @ part.R.T, np.eye(3), atol=1e-12)
    inside = np.abs((turned(CUBE, R).points - part.position) @ part.R)
    assert (inside <= part.size / 2 + 1e-9).all()


@pytest.mark.parametrize("R", [np.eye(3), TURN])
def test_a_body_with_prints_on_one_side_is_a_plate_below_them(R: Array):
    """Its top is below all prints, and no card reaches beyond its rim."""
    robot = turned(FLAT, R)
    part = enclosing_part(robot)
    assert not part.is_box
    at = (robot.points - part.position) @ part.R
    assert (at[:, 2] > -1e-9).all()
    card = robot.surround_ratio * robot.diameter_m / 2
    assert (np.linalg.norm(at[:, :2], axis=1) + card <= part.size[0]).all()


@pytest.mark.parametrize("mesh", [cylinder_mesh(0.1, 0.03), box_mesh()])
def test_a_mesh_is_closed_and_faces_outwards(mesh: Mesh):
    """Each edge belongs to two faces, once in each direction; the volume within is positive."""
    vertices, faces = mesh
    edges = [tuple(edge) for face in faces.tolist() for edge in zip(face, face[1:] + face[:1], strict=True)]
    assert sorted(edges) == sorted((b, a) for a, b in edges)
    assert len(set(edges)) == len(edges)
    assert np.linalg.det(vertices[faces]).sum() > 0


def state_of(seen: list[int]) -> ArenaState:
    """The cube in an oblique pose, of which a camera sees some markers, beside a robot of unknown shape."""
    state = ArenaState(declared={"cube": CUBE})
    pose = RobotPose(
        robot="cube",
        t_ns=0,
        state="tracked",
        position=(1.0, 2.0, 0.5),
        quaternion_wxyz=(0.5, 0.5, 0.5, -0.5),
        velocity=(0, 0, 0),
        angular_velocity=(0, 0, 0),
        covariance=bytes(576),
        n_markers=len(seen),
    )
    state.poses = {
        "cube": TimedMessage(pose, 0.0),
        "other": TimedMessage(msgspec.structs.replace(pose, robot="other"), 0.0),
    }
    n = len(seen)
    markers = Markers(
        t_ns=0,
        robots=("cube",),
        camera_names=("north",),
        position=bytes(24 * n),
        covariance=bytes(36 * n),
        normal=bytes(12 * n),
        robot=np.zeros(n, "<i4").tobytes(),
        marker=np.array(seen, "<i4").tobytes(),
        cameras=bytes(8 * n),
    )
    state.markers = TimedMessage(markers, 0.0)
    return state


def test_prints_are_on_their_sides_and_bright_while_seen(server: viser.ViserServer):
    """Card and ring of each declared marker lie at most 6 mm above it, and face as it does."""
    drawing = RobotDrawing(server.scene)
    seen = [0, 1, 7]
    drawing.draw(state_of(seen), is_slow=True)
    R, at = rotation_from_wxyz((0.5, 0.5, 0.5, -0.5)), np.array([1.0, 2.0, 0.5])
    places, normals = CUBE.points @ R.T + at, CUBE.unit_normals @ R.T
    for layer in drawing.prints.layers:
        above = layer.handle.batched_positions - places
        np.testing.assert_allclose(np.linalg.norm(above, axis=1), np.sum(above * normals, axis=1), atol=1e-6)
        assert np.linalg.norm(above, axis=1).max() < 0.0061
        np.testing.assert_allclose(
            rotation_from_wxyz(layer.handle.batched_wxyzs)[:, :, 2], normals, atol=1e-6
        )
    is_bright = (drawing.prints.layers[0].handle.batched_colors == CARD).all(1)
    assert np.flatnonzero(is_bright).tolist() == seen
    drawing.draw(state_of([]), is_slow=True)
    assert (drawing.prints.layers[0].handle.batched_colors == CARD_UNSEEN).all()


def test_robots_disappear(server: viser.ViserServer):
    """With their bodies and prints."""
    drawing = RobotDrawing(server.scene)
    drawing.draw(state_of([0]), is_slow=True)
    drawing.draw(ArenaState(), is_slow=True)
    assert all(layer.handle is None for layer in drawing.prints.layers)
