# SPDX-License-Identifier: BSD-3-Clause
"""Planar poses (x, y, heading) as arrays (3,), metres and radians: T_a_b is the pose of b in a."""

import numpy as np

from camera_node.foundation.arrays import Array


def compose(T_a_b: Array, T_b_c: Array) -> Array:
    """T_a_c (3,)."""
    c, s = np.cos(T_a_b[2]), np.sin(T_a_b[2])
    x, y, turn = T_b_c
    return np.array([T_a_b[0] + c * x - s * y, T_a_b[1] + s * x + c * y, wrap(T_a_b[2] + turn)])


def between(T_a_b: Array, T_a_c: Array) -> Array:
    """T_b_c (3,)."""
    c, s = np.cos(T_a_b[2]), np.sin(T_a_b[2])
    dx, dy = T_a_c[0] - T_a_b[0], T_a_c[1] - T_a_b[1]
    return np.array([c * dx + s * dy, c * dy - s * dx, wrap(T_a_c[2] - T_a_b[2])])


def moved(T: Array, twist: Array, dt_s: float) -> Array:
    """The pose after `dt_s` with a constant `twist` (3,): forward and left m/s, counter-clockwise rad/s."""
    step = twist * dt_s
    half = step[2] / 2
    chord = np.sinc(half / np.pi)  # of an arc of length 1 and angle 2 half
    c, s = chord * np.cos(half), chord * np.sin(half)
    return compose(T, np.array([c * step[0] - s * step[1], s * step[0] + c * step[1], step[2]]))


def wrap(angle: float) -> float:
    """The same angle in [-pi, pi)."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
