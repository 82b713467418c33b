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

from camera_node.arrays import Array, Index, Mask
from camera_node.geometry.body import Body


@dataclass(frozen=True, slots=True)
class AffineWand:
    """Markers as combinations of basis markers.

    Attributes:
        basis: (B,) indices of the basis markers: 1, 2 on a line, 3 in a plane or 4.
        weights: (M, B) rows that sum to 1; marker k = weights[k] @ basis points.
        pairs: (E, 2) pairs of the basis, by their place in it.
        lengths: (E,) their distances, metres.
    """

    basis: Index
    weights: Array
    pairs: Index
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


@dataclass(frozen=True, slots=True)
class Place:
    """Where on the trajectory frames are: `link` (n,) is the interval between knots, `own` (n,) tells 0 or 1, the knot
    of it that a frame extrapolates, where it is not `inside` (n,) the interval; `spread` (n,) is the variance of a
    position there, were both knots known, for an acceleration of power spectral density 1."""

    link: Index
    own: Index
    inside: Mask
    spread: Array


def locate(knot_s: Array, t_s: Array, gap_s: float) -> Place:
    """Place frames at `t_s` (n,) between K >= 2 ascending knots; intervals above `gap_s` are gaps."""
    link = np.clip(np.searchsorted(knot_s, t_s, side="right") - 1, 0, len(knot_s) - 2)
    dt, tau = knot_s[link + 1] - knot_s[link], t_s - knot_s[link]
    inside = (dt <= gap_s) & (tau >= 0) & (tau <= dt)
    own = (tau > dt / 2).astype(np.intp)
    beyond = np.abs(t_s - knot_s[link + own])
    spread = np.where(inside, (tau * (dt - tau) / dt) ** 3 / 3, beyond**3 / 3)
    return Place(link, own, inside, spread)


def interpolate(knot_s: Array, t_s: Array, place: Place) -> Array:
    """(n, 4) weights of p0, v0, p1, v1 in the position at `t_s`; beyond a knot with constant velocity."""
    tau = t_s - knot_s[place.link + place.own]
    weights = np.zeros((len(tau), 4))
    rows = np.arange(len(tau))
    weights[rows, 2 * place.own], weights[rows, 2 * place.own + 1] = 1.0, tau
    first = place.link[place.inside]
    weights[place.inside] = hermite(t_s[place.inside] - knot_s[first], knot_s[first + 1] - knot_s[first])
    return weights


def hermite_rate(knot_s: Array, t_s: Array, place: Place) -> Array:
    """(n, 4) derivative of `interpolate`'s weights by time: the weights of the velocity."""
    weights = np.zeros((len(t_s), 4))
    weights[np.arange(len(t_s)), 2 * place.own + 1] = 1.0
    first = place.link[place.inside]
    dt = knot_s[first + 1] - knot_s[first]
    s = (t_s[place.inside] - knot_s[first]) / dt
    weights[place.inside] = np.column_stack(
        [6 * s * (s - 1) / dt, (1 - s) * (1 - 3 * s), 6 * s * (1 - s) / dt, s * (3 * s - 2)]
    )
    return weights


def whitened_motion(dt: Array, density: float) -> Array:
    """(L, 2, 4) whitened errors of constant velocity over `dt`, as factors of p0, v0, p1, v1, along one axis.

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
    """Velocities (K, B, 3) at the knots by central differences of positions (K, B, 3); 0 where no knot is near."""
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

    Under the prior, the mean velocities of two neighbouring intervals dt differ with variance 2/3 density dt. Of these
    differences the 90 % quantile counts: a wave has calm parts, and its brisk ones must not be smoothed away; noise in
    the positions only makes the prior weaker.
    """
    dt = np.diff(knot_s)
    steps = np.diff(points, axis=0) / dt[:, None, None]
    near = (dt[1:] <= gap_s) & (dt[:-1] <= gap_s)
    if not near.any():
        return 1.0
    spread = np.abs(np.diff(steps, axis=0))[near] / np.sqrt((dt[1:] + dt[:-1])[near] / 3)[:, None, None]
    return max(float((np.quantile(spread, 0.9) / 1.645) ** 2), 1e-6)
