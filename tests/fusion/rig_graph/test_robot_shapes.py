# SPDX-License-Identifier: BSD-3-Clause
"""Markers that are not where their robots were measured."""

import numpy as np
import pytest

from camera_node.geometry.pose import rotation_from_vector
from fusion.model.observations import MarkerTable
from fusion.model.robots import Robot
from fusion.rig_graph.robot_shapes import DISPLACED_M, MIN_WINDOWS, RobotShapes, in_own_frame

PLACES = np.array([[0.08, 0.05, 0.0], [-0.07, 0.06, 0.0], [-0.06, -0.08, 0.01], [0.05, -0.07, 0.0]])
NOISE_M = 1e-4  # of a coordinate in a window
TURN, SHIFT = rotation_from_vector([0.004, -0.003, 0.006]), np.array([0.002, -0.001, 0.003])


def moved(off: np.ndarray) -> np.ndarray:
    """Displacements as a window may show them: with any small motion of the robot's frame."""
    return (PLACES + off) @ TURN.T + SHIFT - PLACES


@pytest.mark.parametrize("marker", range(len(PLACES)))
@pytest.mark.parametrize("off_m", [0.003, 0.02])
def test_the_frame_of_a_robot_is_where_most_of_its_markers_stay(marker: int, off_m: float):
    """To second order of the motion, 0.006 rad squared of 0.1 m, and in the share of it that Cauchy leaves."""
    off = np.zeros_like(PLACES)
    off[marker] = off_m * np.array([0.8, -0.6, 0.0])
    np.testing.assert_allclose(in_own_frame(PLACES, moved(off)), off, atol=0.03 * off_m)


def learned(off: np.ndarray, windows: int = 20, seed: int = 0) -> tuple[np.ndarray, int]:
    """The places that are used in the end, less those declared, and after how many windows they changed."""
    robot = Robot(diameter_m=0.06, markers=tuple(tuple(place) for place in PLACES.tolist()))
    markers, rng, changed = MarkerTable.of([robot]), np.random.default_rng(seed), 0
    shapes = RobotShapes(markers)
    for n in range(windows):
        left = moved(PLACES + off - markers.position.T)
        if shapes.add({0: left + NOISE_M * rng.standard_normal(PLACES.shape)}):
            changed = n + 1
    return markers.position.T - PLACES, changed


def test_a_displaced_marker_is_used_where_windows_show_it():
    off = np.zeros_like(PLACES)
    off[1] = 0.005, 0.002, 0.0
    found, changed = learned(off)
    assert changed == MIN_WINDOWS
    np.testing.assert_allclose(found, off, atol=5 * NOISE_M / MIN_WINDOWS**0.5 + 0.03 * 0.005)


@pytest.mark.parametrize("seed", range(5))
def test_markers_that_windows_show_in_their_places_stay(seed: int):
    assert learned(np.zeros_like(PLACES), seed=seed)[1] == 0
    off = 0.3 * DISPLACED_M * np.random.default_rng(seed).standard_normal(PLACES.shape)
    off *= 0.5 * DISPLACED_M / np.linalg.norm(off, axis=1).max()
    assert learned(off, seed=seed)[1] == 0


def test_a_robot_of_another_size_stays_as_it_is():
    """The rig may have another size: one robot does not show which."""
    assert learned(0.02 * PLACES)[1] == 0
