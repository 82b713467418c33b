# SPDX-License-Identifier: BSD-3-Clause
"""Gates follow from the covariances of the states."""

import numpy as np
import pytest

from camera_node.detection.roundels import Roundels
from camera_node.geometry.pose import rotation_from_vector
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.observations import CameraArray, MarkerTable
from fusion.model.robots import Robot
from fusion.model.states import States
from fusion.tracking.association import Association
from tests.fusion.synthetic import WIDE, ring


def place(states: States, marker: np.ndarray, tau: float) -> np.ndarray:
    """(N, 3) positions of a marker `tau` seconds after the states, with constant velocities."""
    arm = np.einsum("nij,j->ni", states.R, marker)
    return states.p + arm + tau * (states.v + np.cross(states.omega, arm))


@pytest.mark.parametrize("tau", [0.0, 0.02, -0.05])
def test_the_covariance_of_a_marker_is_that_of_displaced_states(tau: float):
    """Compared with J P J^T from central differences for a body without rotation: exact to second order, 1e-8."""
    random = np.random.default_rng(5)
    root = 0.1 * random.normal(size=(1, 12, 12))
    R = rotation_from_vector(np.array([[0.4, -0.8, 1.1]]))
    v, still = random.normal(size=(1, 3)), np.zeros((1, 3))
    states = States(R, random.normal(size=(1, 3)), still, v, root @ root.transpose(0, 2, 1))
    marker_table = MarkerTable.of([WIDE])
    found = marker_table.expected(np.arange(len(marker_table)), states).covariances(tau)
    steps = 1e-4 * np.eye(12)[:, None]
    for k, marker in enumerate(marker_table.position.T):
        J = np.column_stack(
            [
                (place(states.retract(step), marker, tau) - place(states.retract(-step), marker, tau))[0]
                / 2e-4
                for step in steps
            ]
        )
        np.testing.assert_allclose(found[k], J @ states.P[0] @ J.T, atol=1e-7)


@pytest.mark.parametrize("measured", [0, 1])
def test_of_two_markers_in_line_the_one_of_the_measured_size_is_assigned(measured: int):
    """One robot occludes the other. Their sizes differ by a third; the roundel has the size of one, but the other was
    predicted at its position, and this one 1.5 px away."""
    camera = ring(1)["cam0"]
    cameras = CameraArray({"cam0": camera})
    marker_table = MarkerTable.of([Robot(diameter_m=d, markers=((0.0, 0.0, 0.0),)) for d in (0.10, 0.13)])
    T = camera.matrix()
    at = np.array([0.0, 0.0, 2.0])
    aside = 1.5 / camera.fx * at[2] * np.eye(3)[0]
    seen_from = [at + aside, at] if measured == 0 else [at, at + aside]
    p = np.array([T[:3, :3] @ point + T[:3, 3] for point in seen_from])
    toward = np.tile(T[:3, :3] @ np.diag([1.0, -1.0, -1.0]), (2, 1, 1))  # their normals point to the camera
    states = States.at_rest(toward, p, (0.01, 0.001, 0.01, 0.01))
    major = 2 * camera.fx * marker_table.radius[measured] / at[2]
    seen = Roundels.from_points(camera.project([at]), 0.05)
    seen = Roundels(
        seen.uv, seen.cov, np.full((1, 2), major), np.zeros(1), seen.ratio, seen.contrast, seen.id, seen.track
    )
    association = Association.of(cameras, marker_table, states, np.ones(2, bool), 0)
    frame_set = FrameSet(0, (CalibratedFrame.measure("cam0", 0, seen, camera),))
    assignments = association.extended(frame_set.frames).collect(frame_set)[1]
    assert marker_table.robot[assignments.marker].tolist() == [measured]
