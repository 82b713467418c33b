# SPDX-License-Identifier: BSD-3-Clause
"""Jacobians of pixels by points, poses and lenses agree with central differences."""

import numpy as np
import pytest

from calib.rig.camera import LENS, PER_CAMERA, POSE, pixel_jacobians
from calib.wand.bundle_adjustment.problem import State
from camera_node.geometry.lens import Lens

SIZE = {"width": 1280, "height": 800, "fx": 810.0, "fy": 805.0, "cx": 633.0, "cy": 404.0}
LENSES = {
    "no distortion": Lens(**SIZE),
    "pinhole": Lens(**SIZE, distortion=(-0.1, 0.03, 0.0002, -0.0001, 0.01)),
    "fisheye, none": Lens(**SIZE, model="fisheye"),
    "fisheye": Lens(**SIZE, model="fisheye", distortion=(-0.02, 0.004, -0.001, 0.0002)),
}


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_jacobians_agree_with_steps_of_the_state(lens: Lens):
    """The error of central differences is the squared step over the squared size of the scene, plus rounding over the
    step: at most 1e-3 of 800 px per unit."""
    rng, h = np.random.default_rng(1), 1e-6
    points = np.column_stack([rng.uniform(-1, 1, (6, 2)), rng.uniform(1, 4, 6)])
    state = State.of(np.eye(4)[None], np.zeros(1), np.zeros((2, 2, 1, 3)))

    def see(step, shift):
        moved = state.retract(step[None], np.zeros(12), state.shape)
        T = moved.cameras[0]
        return moved.lens(0, lens).project((points + shift - T[:3, 3]) @ T[:3, :3])

    uv, J_point, J_pose, J_lens = pixel_jacobians(lens, points)
    still, steps = np.zeros(PER_CAMERA), h * np.eye(PER_CAMERA)
    assert uv == pytest.approx(lens.project(points), abs=1e-9)
    for k, shift in enumerate(h * np.eye(3)):
        expected = (see(still, shift) - see(still, -shift)) / (2 * h)
        assert J_point[:, :, k] == pytest.approx(expected, abs=1e-3)
    for J, step in zip([*J_pose.T, *J_lens.T], steps[[*POSE, *LENS]], strict=True):
        assert pytest.approx((see(step, 0) - see(-step, 0)) / (2 * h), abs=1e-3) == J.T


def test_jacobians_are_nan_behind_the_camera():
    for part in pixel_jacobians(LENSES["pinhole"], [[0.0, 0.0, -1.0]]):
        assert np.isnan(part).all()
