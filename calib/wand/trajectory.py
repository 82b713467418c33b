# SPDX-License-Identifier: BSD-3-Clause
"""The wand's continuous-time trajectory: positions and velocities at knots, white noise on acceleration between them.

The posterior mean of that prior between two knots is the cubic Hermite polynomial (Barfoot, State Estimation for
Robotics, section 11.1; Anderson and Barfoot 2015), so a marker's position at any time is linear in two knots.

The wand is expressed in affine coordinates: every marker is a fixed combination of one to four basis markers, whose
mutual distances keep the wand rigid. A straight wand has no unobservable rotation about its axis in this form.
docs/design/wand_adjustment.md has the equations.
"""

from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array, Index, Mask


def hermite(tau: Array, dt: Array) -> Array:
    """(n, 4) weights of p0, v0, p1, v1 in the position at `tau` (n,) after the first of two knots `dt` (n,) apart."""
    s = tau / dt
    return np.column_stack(
        [(1 + 2 * s) * (1 - s) ** 2, tau * (1 - s) ** 2, s**2 * (3 - 2 * s), tau * s * (s - 1)]
    )


@dataclass(frozen=True, slots=True)
class SplineLocation:
    """Where n times lie among the knots.

    Attributes:
        interval: (n,) index of the interval between knots; it starts at the knot of the same index.
        nearest: (n,) 0 or 1: the knot of the interval from which times outside it are extrapolated.
        inside: (n,) whether the time lies inside an interval that is no gap.
        spread: (n,) variance of the position given both knots, for an acceleration of power spectral density 1, s^3.
    """

    interval: Index
    nearest: Index
    inside: Mask
    spread: Array


def locate(knot_s: Array, t_s: Array, gap_s: float) -> SplineLocation:
    """Locate times `t_s` (n,) among K >= 2 ascending knots; intervals longer than `gap_s` are gaps."""
    interval = np.clip(np.searchsorted(knot_s, t_s, side="right") - 1, 0, len(knot_s) - 2)
    dt, tau = knot_s[interval + 1] - knot_s[interval], t_s - knot_s[interval]
    inside = (dt <= gap_s) & (tau >= 0) & (tau <= dt)
    nearest = (tau > dt / 2).astype(np.intp)
    beyond = np.abs(t_s - knot_s[interval + nearest])
    spread = np.where(inside, (tau * (dt - tau) / dt) ** 3 / 3, beyond**3 / 3)
    return SplineLocation(interval, nearest, inside, spread)


def position_weights(knot_s: Array, t_s: Array, location: SplineLocation) -> Array:
    """(n, 4) weights of p0, v0, p1, v1 in the position at `t_s`; constant velocity outside of the intervals."""
    tau = t_s - knot_s[location.interval + location.nearest]
    weights = np.zeros((len(tau), 4))
    rows, inside = np.arange(len(tau)), location.inside
    weights[rows, 2 * location.nearest], weights[rows, 2 * location.nearest + 1] = 1.0, tau
    first = location.interval[inside]
    weights[inside] = hermite(t_s[inside] - knot_s[first], knot_s[first + 1] - knot_s[first])
    return weights


def velocity_weights(knot_s: Array, t_s: Array, location: SplineLocation) -> Array:
    """(n, 4) weights of p0, v0, p1, v1 in the velocity at `t_s`: the time derivative of `position_weights`."""
    weights, inside = np.zeros((len(t_s), 4)), location.inside
    weights[np.arange(len(t_s)), 2 * location.nearest + 1] = 1.0
    first = location.interval[inside]
    dt = knot_s[first + 1] - knot_s[first]
    s = (t_s[inside] - knot_s[first]) / dt
    weights[inside] = np.column_stack(
        [6 * s * (s - 1) / dt, (1 - s) * (1 - 3 * s), 6 * s * (1 - s) / dt, s * (3 * s - 2)]
    )
    return weights


def whitened_constant_velocity(dt: Array, density: float) -> Array:
    """(L, 2, 4) whitened deviations from constant velocity over `dt`, as factors of p0, v0, p1, v1, along one axis.

    Args:
        dt: (L,) times between the knots, s.
        density: power spectral density of the acceleration, m^2/s^3.
    """
    error, Q = np.zeros((len(dt), 2, 4)), np.empty((len(dt), 2, 2))
    error[:, 0, 0], error[:, 0, 1], error[:, 0, 2] = -1.0, -dt, 1.0
    error[:, 1, 1], error[:, 1, 3] = -1.0, 1.0
    Q[:, 0, 0], Q[:, 0, 1], Q[:, 1, 0], Q[:, 1, 1] = dt**3 / 3, dt**2 / 2, dt**2 / 2, dt
    return np.asarray(np.linalg.solve(np.linalg.cholesky(density * Q), error), float)


def finite_velocities(knot_s: Array, points: Array, gap_s: float) -> Array:
    """Velocities (K, B, d) at the knots by central differences of positions (K, B, d); 0 where no knot is within
    `gap_s`."""
    velocity = np.zeros_like(points)
    if len(knot_s) < 2:
        return velocity
    dt = np.diff(knot_s)
    steps = np.diff(points, axis=0) / dt[:, None, None]
    near = (dt <= gap_s).astype(float)
    total = np.concatenate([near, [0.0]]) + np.concatenate([[0.0], near])
    velocity[:-1] += steps * near[:, None, None]
    velocity[1:] += steps * near[:, None, None]
    return velocity / np.maximum(total, 1.0)[:, None, None]


def acceleration_density(knot_s: Array, points: Array, gap_s: float) -> float:
    """Power spectral density of the acceleration, m^2/s^3, at least 1e-6, from positions (K, B, 3) at knots.

    Under the prior, the mean velocities of two neighbouring intervals dt differ with variance 2/3 density dt. The 90 %
    quantile of these differences gives the density: the mean would be too small for fast motion, because recordings
    have slow parts. Noise in the positions only makes the prior weaker.
    """
    dt = np.diff(knot_s)
    steps = np.diff(points, axis=0) / dt[:, None, None]
    near = (dt[1:] <= gap_s) & (dt[:-1] <= gap_s)
    if not near.any():
        return 1.0
    spread = np.abs(np.diff(steps, axis=0))[near] / np.sqrt((dt[1:] + dt[:-1])[near] / 3)[:, None, None]
    return max(float((np.quantile(spread, 0.9) / 1.645) ** 2), 1e-6)
