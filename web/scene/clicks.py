# SPDX-License-Identifier: BSD-3-Clause
"""What a click in the scene selects."""

import numpy as np
from numpy.typing import ArrayLike

from camera_node.foundation.arrays import Array

MAX_ANGLE_RAD = 0.03  # between the ray of a click and the direction of what it selects


def nearest_to_ray(points: Array, origin: ArrayLike, direction: ArrayLike) -> int | None:
    """The row of the point (N, 3) that is nearest to a ray, by angle; None if none is near it."""
    ray = np.asarray(direction, float) / np.linalg.norm(direction)
    to_point = points - np.asarray(origin, float)
    angle = np.linalg.norm(np.cross(to_point, ray), axis=1) / np.maximum(to_point @ ray, 1e-9)
    if not len(angle) or np.isnan(angle).all() or np.nanmin(angle) > MAX_ANGLE_RAD:
        return None
    return int(np.nanargmin(angle))
