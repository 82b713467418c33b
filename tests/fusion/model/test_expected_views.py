# SPDX-License-Identifier: BSD-3-Clause
"""The motion of a camera is found from where it shows markers."""

import msgspec
import numpy as np
import pytest

from calib.rig.camera import Camera
from camera_node.geometry.pose import Pose, rotation_from_vector
from fusion.model.expected_views import MOVED, TURNED, ExpectedViews, match_moved
from tests.fusion.synthetic import ring

CAMERA = ring()["cam0"]
N_STRANGE = 20  # roundels in the image that are no marker


def scene(n: int, seed: int) -> ExpectedViews:
    """`n` markers in the image."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-1.2, -1.2, 0.0), (1.2, 1.2, 0.6), (n, 3))
    return ExpectedViews(np.arange(n), points.T, CAMERA.project_world(points))


def moved(turn_deg: tuple[float, float, float], shift_m: tuple[float, float, float] = (0, 0, 0)) -> Camera:
    """The camera after a motion, in its own axes."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation_from_vector(np.radians(turn_deg)), shift_m
    return msgspec.structs.replace(CAMERA, T_world_cam=Pose.from_matrix(CAMERA.matrix() @ motion))


def images(camera: Camera, expected: ExpectedViews, seed: int) -> np.ndarray:
    """Pixels of the markers by a camera, then of other roundels."""
    strange = np.random.default_rng([seed, 1]).uniform((0, 0), (800, 600), (N_STRANGE, 2))
    return np.concatenate([camera.project_world(expected.points.T), strange])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("turn_deg", [(0, 0, 0), (1.3, -2.8, 0), (1.3, -2.8, 2.6), (-4, 3, -5), (0, 0, 4)])
def test_a_turn_about_any_axis_is_found(turn_deg: tuple[float, float, float], seed: int):
    """A turn about the optical axis shifts the image by 25 px at its edges and not at all in the middle."""
    camera, expected = moved(turn_deg), scene(30, seed)
    detected = images(camera, expected, seed)
    T, ((rows, found),) = match_moved(CAMERA, [expected], [detected], TURNED)
    assert np.allclose(T, camera.matrix(), atol=1e-6)
    right = rows == found
    assert right.sum() >= 0.9 * len(expected.rows)  # beside a marker may be a nearer roundel


def test_a_moved_camera_is_found_from_several_frames():
    camera, views = moved((1.0, 2.0, -2.0), (0.03, -0.02, 0.01)), [scene(8, seed) for seed in range(5)]
    detected = [images(camera, expected, seed) for seed, expected in enumerate(views)]
    T, _ = match_moved(CAMERA, views, detected, MOVED)
    assert np.allclose(T, camera.matrix(), atol=1e-6)


def test_too_few_markers_leave_the_pose_as_calibrated():
    """Two determine a shift, and it pairs them."""
    expected = scene(2, 0)
    T, ((rows, found),) = match_moved(CAMERA, [expected], [expected.uv + np.array([50.0, -20.0])], TURNED)
    assert np.array_equal(T, CAMERA.matrix())
    assert rows.tolist() == found.tolist() == [0, 1]
