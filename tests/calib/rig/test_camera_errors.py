# SPDX-License-Identifier: BSD-3-Clause
"""What the errors of cameras displace in their images."""

import msgspec
import numpy as np
import pytest

from calib.rig.camera_errors import USUAL_PX, error_covariance, image_errors, working_ranges
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


@pytest.mark.parametrize("n", [1, 2, 4])
def test_ranges_are_those_to_the_point_that_all_cameras_look_at(n: int):
    cameras = list(ring(n).values())
    expected = 1.0 if n == 1 else np.linalg.norm([2.5, 0.0, 2.8])
    assert working_ranges(cameras) == pytest.approx(np.full(n, expected), rel=0.01)
