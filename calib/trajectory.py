# SPDX-License-Identifier: BSD-3-Clause
"""The wand's motion: positions and velocities at knots, white noise on acceleration between them.

The posterior mean of that prior between two knots is the cubic Hermite polynomial (Barfoot, State Estimation for
Robotics, section 11.1; Anderson and Barfoot 2015), so a frame taken at any time sees a linear function of two knots.

The wand is written in affine coordinates: every marker is a fixed combination of one to four basis markers, whose
mutual distances keep it rigid. A straight wand thus has no turn about itself that would need an anchor.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from camera_node.body import Body

Array = NDArray[np.float64]

MAX_GAP_S = 0.5  # knots further apart say nothing of each other


@dataclass(frozen=True, slots=True)
class AffineWand:
    """Markers as combinations of basis markers.

    Attributes:
        basis: (B,) indices of the basis markers: 1, 2 on a line, 3 in a plane or 4.
        weights: (M, B) rows that sum to 1; marker k = weights[k] @ basis points.
        pairs: (E, 2) pairs of the basis, by their place in it.
        lengths: (E,) their distances, metres.
    """

    basis: NDArray[np.intp]
    weights: Array
    pairs: NDArray[np.intp]
    lengths: Array

    @classmethod
    def of(cls, wand: Body) -> "AffineWand":
        """Basis markers as far apart as can be: each next one is the farthest from the span of those before."""
        points = wand.points
        extent = np.ptp(points, axis=0).max()
        basis = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
        while len(basis) < min(4, len(points)):
            off = (points - points[basis[0]]).T
            if len(basis) > 1:
                span = np.linalg.qr((points[basis[1:]] - points[basis[0]]).T)[0]
                off = off - span @ (span.T @ off)
            if (distance := np.linalg.norm(off, axis=0)).max() < 0.01 * extent:
                break
            basis.append(int(distance.argmax()))
        system = np.vstack([points[basis].T, np.ones(len(basis))])
        weights = np.linalg.lstsq(system, np.vstack([points.T, np.ones(len(points))]), rcond=None)[0].T
        pairs = np.array(list(combinations(range(len(basis)), 2)), np.intp).reshape(-1, 2)
        ends = points[basis][pairs]
        lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
        return cls(np.array(basis), np.asarray(weights, float), pairs, lengths)


def hermite(tau: Array, dt: Array) -> Array:
    """(n, 4) weights of p0, v0, p1, v1 in the position at `tau` after the first of two knots `dt` apart."""
    s = tau / dt
    return np.column_stack(
        [(1 + 2 * s) * (1 - s) ** 2, tau * (1 - s) ** 2, s**2 * (3 - 2 * s), tau * s * (s - 1)]
    )


def interpolate(knot_s: Array, t_s: Array, own: NDArray[np.intp]) -> tuple[NDArray[np.intp], Array]:
    """Which knots a frame at `t_s` (n,) depends on, given the knot `own` (n,) that is nearest to it.

    Returns:
        knots: (n, 2) the knots before and after; twice `own` where the next one is too far, or none.
        weights: (n, 4) of p0, v0, p1, v1; there (1, tau, 0, 0): constant velocity.
    """
    first = np.where(t_s >= knot_s[own], own, own - 1)
    inside = (first >= 0) & (first + 1 < len(knot_s))
    first = np.clip(first, 0, max(len(knot_s) - 2, 0))
    last = np.minimum(first + 1, len(knot_s) - 1)
    dt = knot_s[last] - knot_s[first]
    linked = inside & (dt <= MAX_GAP_S) & (dt > 0)
    knots = np.where(linked[:, None], np.column_stack([first, last]), own[:, None])
    tau = t_s - knot_s[own]
    weights = np.column_stack([np.ones(len(tau)), tau, np.zeros(len(tau)), np.zeros(len(tau))])
    weights[linked] = hermite((t_s - knot_s[first])[linked], dt[linked])
    return knots, weights


def whitened_motion(dt: float, density: float) -> Array:
    """(2, 4) whitened error of constant velocity over `dt`, as factors of p0, v0, p1, v1, along one axis.

    Args:
        dt: time between the knots, s.
        density: power spectral density of the acceleration, m^2/s^3.
    """
    error = np.array([[-1.0, -dt, 1.0, 0.0], [0.0, -1.0, 0.0, 1.0]])
    Q = density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    return np.asarray(np.linalg.solve(np.linalg.cholesky(Q), error), float)


def finite_velocities(knot_s: Array, points: Array) -> Array:
    """Velocities (K, B, 3) at the knots by central differences of positions (K, B, 3); 0 where no knot is near."""
    velocity = np.zeros_like(points)
    if len(knot_s) < 2:
        return velocity
    dt = np.diff(knot_s)
    steps = np.diff(points, axis=0) / dt[:, None, None]
    near = (dt <= MAX_GAP_S).astype(float)
    total = np.concatenate([near, [0.0]]) + np.concatenate([[0.0], near])
    velocity[:-1] += steps * near[:, None, None]
    velocity[1:] += steps * near[:, None, None]
    return velocity / np.maximum(total, 1.0)[:, None, None]


def acceleration_density(knot_s: Array, points: Array) -> float:
    """Power spectral density of the acceleration, m^2/s^3, at least 1e-6, from positions (K, B, 3) at knots.

    Under the prior, the mean velocities of two neighbouring intervals dt differ with variance 2/3 density dt. Of these
    differences the 90 % quantile counts: a wave has calm parts, and its brisk ones must not be smoothed away; noise in
    the positions only makes the prior weaker.
    """
    dt = np.diff(knot_s)
    steps = np.diff(points, axis=0) / dt[:, None, None]
    near = (dt[1:] <= MAX_GAP_S) & (dt[:-1] <= MAX_GAP_S)
    if not near.any():
        return 1.0
    spread = np.abs(np.diff(steps, axis=0))[near] / np.sqrt((dt[1:] + dt[:-1])[near] / 3)[:, None, None]
    return max(float((np.quantile(spread, 0.9) / 1.645) ** 2), 1e-6)
