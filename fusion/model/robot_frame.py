# SPDX-License-Identifier: BSD-3-Clause
"""Changes a robot's own frame: another origin (pivot), or another direction of its x axis (heading)."""

import math

import msgspec
import numpy as np

from camera_node.foundation.arrays import Array
from fusion.errors import FusionError
from fusion.model.robots import Robot

DECIMALS = 5  # of marker positions: hundredths of a millimetre
MAX_PIVOT_M = 5.0


def move_origin(robot: Robot, pivot_m: tuple[float, float, float]) -> Robot:
    """The robot with its origin at `pivot_m`, a point of its present frame, metres.

    Raises:
        FusionError: the point is not finite, or too far away.
    """
    if not all(abs(x) <= MAX_PIVOT_M for x in pivot_m):  # False for NaN
        raise FusionError(
            f"the pivot {pivot_m} is out of range; give metres, within {MAX_PIVOT_M:g} m of the robot"
        )
    return _with_markers(robot, robot.points - np.array(pivot_m), robot.unit_normals)


def turn_heading(robot: Robot, degrees: float) -> Robot:
    """The robot with its x axis turned about its z axis by `degrees`, counterclockwise seen from above.

    Raises:
        FusionError: the angle is not finite.
    """
    if not math.isfinite(degrees):
        raise FusionError(f"the angle {degrees} is no number of degrees")
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    R_old_new = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return _with_markers(robot, robot.points @ R_old_new, robot.unit_normals @ R_old_new)


def _with_markers(robot: Robot, points: Array, normals: Array) -> Robot:
    markers, directions = (
        tuple(map(tuple, (np.round(rows, DECIMALS) + 0.0).tolist())) for rows in (points, normals)
    )
    return msgspec.structs.replace(robot, markers=markers, normals=directions)
