# SPDX-License-Identifier: BSD-3-Clause
"""Evenly distributed directions on the unit sphere."""

import numpy as np

from camera_node.foundation.arrays import Array


def fibonacci_sphere(n: int) -> Array:
    """(n, 3) unit vectors on a Fibonacci lattice (Gonzalez 2010)."""
    k = np.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    level = np.sqrt(1 - z**2)
    return np.column_stack([level * np.cos(turn), level * np.sin(turn), z])
