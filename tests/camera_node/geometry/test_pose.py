# SPDX-License-Identifier: BSD-3-Clause
"""Poses form a group, and conversions between forms of rotations are exact."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from camera_node.geometry.pose import (
    Pose,
    adjoint,
    invert,
    look_at,
    rotation_angle,
    rotation_from_vector,
    rotation_from_wxyz,
    skew,
    vector_from_rotation,
    wxyz_from_rotation,
)

EPS = 1e-12  # a few hundred roundings of numbers near 1
coordinate = st.floats(-10, 10)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.01)
poses = st.builds(Pose, st.tuples(coordinate, coordinate, coordinate), quaternions)
half_turns = st.tuples(st.just(0.0), *[st.floats(-1, 1)] * 3).filter(lambda q: np.linalg.norm(q) > 0.01)


@given(poses, poses, poses)
def test_poses_form_a_group(a: Pose, b: Pose, c: Pose):
    """Associative, with an inverse on both sides; entries reach 50, hence the factor."""
    A, B, C = a.matrix(), b.matrix(), c.matrix()
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=50 * EPS)
    np.testing.assert_allclose(A @ invert(A), np.eye(4), atol=50 * EPS)
    np.testing.assert_allclose(invert(A @ B), invert(B) @ invert(A), atol=50 * EPS)


@given(quaternions | half_turns)
def test_a_rotation_is_recovered_from_its_quaternion(q: tuple[float, ...]):
    """Also a half turn, where w is 0 and the trace holds no information."""
    R = rotation_from_wxyz(q)
    wxyz = wxyz_from_rotation(R)
    assert wxyz[0] >= 0
    assert np.linalg.norm(wxyz) == pytest.approx(1, abs=EPS)
    np.testing.assert_allclose(rotation_from_wxyz(wxyz), R, atol=EPS)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=EPS)
    assert np.linalg.det(R) == pytest.approx(1, abs=EPS)


@given(poses)
def test_a_pose_is_recovered_from_its_matrix(pose: Pose):
    np.testing.assert_allclose(Pose.from_matrix(pose.matrix()).matrix(), pose.matrix(), atol=EPS)


@given(st.lists(st.tuples(*[st.floats(-1.8, 1.8)] * 3), max_size=4))
def test_stacks_of_rotations_equal_single_ones_and_keep_their_vectors(vectors: list[tuple[float, ...]]):
    """Leading axes are free; a vector shorter than half a turn comes back from its rotation."""
    stack = np.array(vectors).reshape(-1, 1, 3)
    R = rotation_from_vector(stack)
    assert (R.shape, wxyz_from_rotation(R).shape) == ((len(stack), 1, 3, 3), (len(stack), 1, 4))
    for vector, rotation, wxyz in zip(vectors, R[:, 0], wxyz_from_rotation(R)[:, 0], strict=True):
        np.testing.assert_array_equal(rotation, rotation_from_vector(vector))
        np.testing.assert_array_equal(wxyz, wxyz_from_rotation(rotation))
    np.testing.assert_allclose(vector_from_rotation(R), stack, atol=1e3 * EPS)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.5, np.pi])
def test_the_angle_of_a_rotation(angle: float):
    assert rotation_angle(rotation_from_vector([0.0, angle, 0.0])) == pytest.approx(angle, abs=1e-9)


def test_a_vector_is_a_rotation_about_its_axis():
    np.testing.assert_allclose(rotation_from_vector([0, 0, np.pi / 2]) @ [1, 0, 0], [0, 1, 0], atol=EPS)
    np.testing.assert_allclose(rotation_from_vector([0, 0, 0]), np.eye(3), atol=EPS)


def test_a_camera_looks_at_its_target_upright():
    T = look_at([4, 1, 3], [0, 0, 0])
    centre = invert(T) @ [0, 0, 0, 1]
    np.testing.assert_allclose(centre[:2], 0, atol=10 * EPS)
    assert centre[2] > 0
    assert T[2, 1] < 0  # image y is down in the world
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)


def test_a_camera_that_looks_straight_down_is_refused():
    with pytest.raises(ValueError, match="exactly above"):
        look_at([0, 0, 3], [0, 0, 0])


@pytest.mark.parametrize("pose", [((0, 0, 0), (0, 0, 0, 0)), ((float("nan"), 0, 0), (1, 0, 0, 0))])
def test_impossible_poses_are_refused(pose: tuple):
    with pytest.raises(ValueError, match=r"zero|finite"):
        Pose(*pose)


@given(poses, st.tuples(*[st.floats(-0.5, 0.5)] * 3), st.tuples(coordinate, coordinate, coordinate))
def test_the_adjoint_transforms_a_twist(pose: Pose, turn: tuple[float, ...], shift: tuple[float, ...]):
    """T Exp(xi) = Exp(Ad xi) T, with SciPy's exponential of 4x4 matrices."""
    T, xi = pose.matrix(), np.array([*turn, *shift])
    np.testing.assert_allclose(T @ expm(_hat(xi)), expm(_hat(adjoint(T) @ xi)) @ T, atol=1e4 * EPS)


def _hat(xi: np.ndarray) -> np.ndarray:
    return np.block([[skew(xi[:3]), xi[3:, None]], [np.zeros((1, 4))]])
