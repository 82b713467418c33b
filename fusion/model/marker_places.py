# SPDX-License-Identifier: BSD-3-Clause
"""Errors of the places of markers on their robot, and what they do to its pose."""

import numpy as np

from camera_node.foundation.arrays import Array

PLACE_M = 3e-4  # standard deviation of a coordinate of a place that was measured or drawn


def motions(places: Array) -> Array:
    """(3 m, 6) displacements of markers at `places` (m, 3) by a small rotation and a translation of their robot."""
    turns = np.cross(np.eye(3), places[:, None]).transpose(0, 2, 1)
    return np.concatenate([turns, np.tile(np.eye(3), (len(places), 1, 1))], axis=2).reshape(-1, 6)


def frame_covariance(places: Array, covariance: Array) -> Array:
    """(6, 6) covariance of a robot's rotation and position (body frame) by errors of the places of its markers.

    Images show where the markers are. If all of them are displaced together, the robot's frame is: by the motion of
    least squares. A lone marker is its robot, wherever it is.

    Args:
        places: (m, 3) of the markers, metres.
        covariance: (3 m, 3 m) of these, square metres.
    """
    if len(places) < 2:
        return np.zeros((6, 6))
    fit = np.linalg.pinv(motions(places))
    return np.asarray(fit @ covariance @ fit.T, float)
