# SPDX-License-Identifier: BSD-3-Clause
"""What the errors of cameras displace in their images."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.rig.camera import LENS, POSE, pixel_jacobians
from calib.rig.camera_errors import (
    ERRORS,
    MAX_JOINT,
    USUAL_PX,
    as_pose_errors,
    error_covariance,
    errors_of_motion,
    image_errors,
    with_errors,
    working_ranges,
)
from calib.rig.rig import Rig, load_rig, save_rig
from calib.world.world_frame import scale_rig
from camera_node.geometry.pose import rotation_from_vector, vector_from_rotation
from tests.fusion.synthetic import ring

CAMERAS = list(ring().values())


def test_a_rig_that_states_nothing_has_the_usual_error_in_its_images():
    """Rays of the image's corners are longer than the optical axis, so its mean is a little above."""
    error_px = image_errors(CAMERAS, error_covariance(CAMERAS))
    assert error_px == pytest.approx(np.full(4, USUAL_PX), rel=0.15)


def test_a_stated_turn_displaces_the_image_by_focal_length_times_angle():
    turn = tuple(map(tuple, np.diag([1e-4, 1e-4, 0, 0, 0, 0])[:, :] ** 2))
    cameras = [msgspec.structs.replace(camera, covariance=turn) for camera in CAMERAS]
    assert image_errors(cameras, error_covariance(cameras)) == pytest.approx(np.full(4, 0.065), rel=0.3)


def test_errors_of_a_common_motion_move_all_cameras_by_it():
    """To first order, in the frame of each camera."""
    T = np.array([camera.matrix() for camera in CAMERAS])
    turn, shift = 1e-6 * np.array([[1, -2, 3], [2, 1, -1]])
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation_from_vector(turn[None])[0], shift
    moved = np.linalg.inv(T) @ motion @ T
    errors = (errors_of_motion(T) @ [*turn, *shift]).reshape(-1, ERRORS)
    assert errors[:, :3] == pytest.approx(vector_from_rotation(moved[:, :3, :3]), abs=1e-10)
    assert errors[:, 3:6] == pytest.approx(moved[:, :3, 3], abs=1e-10)  # turn^2 x 5 m
    assert not errors[:, 6:].any()


@pytest.mark.parametrize("n", [1, 2, 4])
def test_ranges_are_those_to_the_point_that_all_cameras_look_at(n: int):
    cameras = list(ring(n).values())
    expected = 1.0 if n == 1 else np.linalg.norm([2.5, 0.0, 2.8])
    assert working_ranges(cameras) == pytest.approx(np.full(n, expected), rel=0.01)


def joint(n: int, seed: int = 5) -> np.ndarray:
    """(8 n, 8 n) a covariance with cross terms."""
    root = np.random.default_rng(seed).normal(size=(ERRORS * n, ERRORS * n))
    scale = np.tile([1e-4] * 3 + [1e-3] * 3 + [1e-4, 1e-4], n)
    return scale[:, None] * root @ root.T * scale


def assert_alike(found: np.ndarray, expected: np.ndarray) -> None:
    """Covariances of which numbers were rounded to six digits: within 1e-4 standard deviations."""
    sigma = np.sqrt(np.diag(expected))
    assert found / np.outer(sigma, sigma) == pytest.approx(expected / np.outer(sigma, sigma), abs=1e-4)


def test_a_file_holds_the_joint_covariance_with_its_cross_terms(tmp_path: Path):
    rig = Rig(cameras=with_errors(ring(), joint(4)))
    save_rig(rig, tmp_path / "rig.yaml")
    found = error_covariance(list(load_rig(tmp_path / "rig.yaml").cameras.values()))
    assert_alike(found, joint(4))
    shorter = error_covariance(list(rig.cameras.values())[1:])
    assert_alike(shorter, joint(4)[ERRORS:, ERRORS:])


def test_a_camera_that_states_its_own_errors_only_is_independent_of_the_others():
    cameras = with_errors(ring(), joint(4))
    cameras["cam1"] = msgspec.structs.replace(cameras["cam1"], errors=None)
    found = error_covariance(list(cameras.values())).reshape(4, ERRORS, 4, ERRORS)
    assert not found[1][:, [0, 2, 3]].any()
    assert found[0, :, 2] == pytest.approx(
        joint(4).reshape(4, ERRORS, 4, ERRORS)[0, :, 2], rel=1e-4, abs=1e-12
    )


def test_a_large_rig_states_each_camera_apart():
    n = MAX_JOINT + 1
    cameras = with_errors(ring(n), joint(n))
    blocks = joint(n).reshape(n, ERRORS, n, ERRORS)
    found = error_covariance(list(cameras.values())).reshape(n, ERRORS, n, ERRORS)
    assert_alike(found[3, :, 3], blocks[3, :, 3])
    assert not found[3, :, 4].any()


def test_a_rig_that_is_scaled_has_scaled_errors():
    found = error_covariance(
        list(scale_rig(Rig(cameras=with_errors(ring(), joint(4))), 2.0).cameras.values())
    )
    factor = np.tile([1.0] * 3 + [2.0] * 3 + [1.0] * 2, 4)
    assert_alike(found, joint(4) * np.outer(factor, factor))


@pytest.mark.parametrize(
    "errors", [((1.0,),) * 7, ((float("nan"),),) * 8, ((1.0,),) * 7 + ((1.0, 2.0),), ((),) * 8]
)
def test_errors_that_are_none_are_refused(errors: tuple, tmp_path: Path):
    camera = msgspec.structs.replace(ring()["cam0"], errors=errors)
    with pytest.raises((ValueError, CalibrationError), match="errors"):
        save_rig(Rig(cameras={"cam0": camera}), tmp_path / "rig.yaml")


def test_errors_of_a_lens_that_look_like_a_turn_are_that_turn():
    """Cancelling errors displace nothing: a principal point that is off by 1 px, and the turn that undoes it, over a
    narrow part of the image. Poses and lens apart claim 1 px."""
    camera, rng = CAMERAS[0], np.random.default_rng(2)
    points = np.array([0.0, 0.0, 4.0]) + rng.uniform(-0.2, 0.2, (100, 3))
    parameters = (*POSE, LENS[1])
    _, _, J_pose, J_lens = pixel_jacobians(camera, points)
    turn = np.linalg.lstsq(J_pose.reshape(-1, 6), -J_lens[:, :, 1].ravel(), rcond=None)[0]
    found = as_pose_errors(camera, points, parameters) @ np.append(turn, 1.0)
    moved = J_pose @ found[:6] + J_lens[:, :, 0] * found[7]
    assert np.sqrt(np.mean(moved**2)) < 0.01


def test_a_covariance_that_rounding_made_indefinite_is_written():
    """Cameras of which only differences are known: their common motion has variance 0, and rounding makes it less."""
    n = 4
    common = np.tile(np.eye(ERRORS), (n, 1)) / np.sqrt(n)
    apart = np.eye(ERRORS * n) - common @ common.T
    singular = 1e-6 * (apart - 1e-8 * common @ common.T)
    found = error_covariance(list(with_errors(ring(), singular).values()))
    assert found == pytest.approx(1e-6 * apart, abs=1e-11)
