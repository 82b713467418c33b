# SPDX-License-Identifier: BSD-3-Clause
"""Corrects ellipse centres to the projections of the discs' own centres.

Perspective displaces the centre of a disc's image from the projection of the disc's centre, by about
D^2/(4f) sin t cos t pixels for a disc of D pixels that is tilted by t, and the lens's distortion by about a tenth of
that: always to the same side, so the errors do not average out. All markers of the wand face the same way, or the
opposite one, so the ellipses of one frame set together give their normal. A camera that sees one side of a thick wand
sees its discs half the thickness from the markers.
"""

from dataclasses import replace

import numpy as np

from calib.wand.bundle_adjustment.problem import Problem, State, WandObservations
from calib.wand.bundle_adjustment.residuals import point_jacobians, predict_markers
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.body import Body, thickness_of
from camera_node.geometry.lens import Lens
from camera_node.geometry.outline import centre_shifts, disc_pictures, half_axes_of
from camera_node.geometry.sphere import fibonacci_sphere

DIRECTIONS = 160  # on a sphere, tried before refinement: 9 degrees apart
SHAPE_SIGMA = 0.04  # of an ellipse's shape, relative to that of a disc seen frontally
SHAPE_LIMIT = 9.0  # of one ellipse's squared residual: more counts as this
STEPS = 4  # of Gauss-Newton


def with_disc_centres(
    problem: Problem, state: State, observations: WandObservations, wand: Body
) -> WandObservations:
    """The observations of ellipse centres, corrected to the markers of the wand at a state."""
    points = predict_markers(problem, observations, state).points
    lenses = state.corrected(problem.lenses)
    offsets = centre_offsets(lenses, state.cameras, observations, points, wand)
    return replace(observations, uv=observations.uv - offsets)


def centre_offsets(
    lenses: list[Lens], cameras: Array, observations: WandObservations, points: Array, wand: Body
) -> Array:
    """(n, 2) pixels from the projections of the markers to the ellipses' centres of the discs that the cameras see; 0
    where no ellipse of the frame set gives the normal.

    Args:
        lenses, cameras: of C cameras, (C, 4, 4) T_world_cam.
        points: (n, 3) markers, world.
        wand: radius of its discs, and their distance from the markers on both sides.
    """
    radius, half = wand.diameter_m / 2, thickness_of(wand) / 2
    offsets = np.zeros((len(observations), 2))
    local, P = point_jacobians(lenses, cameras, observations.camera, points)
    known = (
        np.isfinite(observations.axes_px).all(axis=1)
        & np.isfinite(P).all(axis=(1, 2))
        & (local[:, 2] > 2 * radius)
    )
    if not known.any():
        return offsets
    normals = _find_normals(cameras, observations.select(known), P[known], points[known], wand)
    rows = np.flatnonzero(np.isfinite(normals[observations.knot, 0]) & (local[:, 2] > 2 * radius))
    for c, lens in enumerate(lenses):
        mine = rows[observations.camera[rows] == c]
        normal = normals[observations.knot[mine]] @ cameras[c, :3, :3]
        side = -np.sign(np.einsum("ni,ni->n", normal, local[mine]))  # whose print the camera sees
        disc = local[mine] + half * side[:, None] * normal
        moved = lens.project(disc) - lens.project(local[mine]) if half else 0.0
        offsets[mine] = np.nan_to_num(displacement(lens, disc, normal, radius) + moved)
    return offsets


def displacement(lens: Lens, points: Array, normals: Array, radius: float) -> Array:
    """(n, 2) pixels from the projections of discs' centres to their ellipses' centres.

    The outline in the image plane is an ellipse (`disc_pictures`), which the lens maps to another one
    (`centre_shifts`).

    Args:
        points, normals: (n, 3) centres, metres, and unit normals, camera frame.
        radius: metres.
    """
    pictures = disc_pictures(points / radius, normals)[0]
    centre, shape = pictures[:, :2], pictures[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    uv = lens.project(np.column_stack([centre, np.ones(len(centre))]))
    return uv + centre_shifts(lens, centre, _root(shape)) - lens.project(points)


def _root(S: Array) -> Array:
    """(n, 2, 2) lower triangular L with L L' = S; NaN where S is not positive definite."""
    L = np.zeros_like(S)
    with np.errstate(invalid="ignore", divide="ignore"):
        L[:, 0, 0] = np.sqrt(S[:, 0, 0])
        L[:, 1, 0] = S[:, 0, 1] / L[:, 0, 0]
        L[:, 1, 1] = np.sqrt(S[:, 1, 1] - L[:, 1, 0] ** 2)
    return L


def _find_normals(
    cameras: Array, observations: WandObservations, P: Array, points: Array, wand: Body
) -> Array:
    """(K, 3) unit normals by frame set, world; NaN without an ellipse.

    A small disc's ellipse is r^2 P (I - n n') P', so its difference to r^2 P P' is r^2 (P n)(P n)', for either sign of
    n.
    """
    half_axes = half_axes_of(observations.axes_px, observations.angle_rad)
    full = P @ np.swapaxes(P, 1, 2)
    unit = np.trace(full, axis1=1, axis2=2)
    deficit = (full - half_axes @ half_axes.mT / (wand.diameter_m / 2) ** 2) / unit[:, None, None]
    P = P / np.sqrt(unit)[:, None, None]
    toward = np.zeros_like(points) if thickness_of(wand) else cameras[observations.camera, :3, 3] - points
    count = int(observations.knot.max()) + 1
    normals = _try_directions(count, observations.knot, P, deficit, toward)
    for _ in range(STEPS):
        normals = _refine(normals, observations.knot, P, deficit)
    normals[np.bincount(observations.knot, minlength=count) == 0] = np.nan
    return normals


def _entries(M: Array) -> Array:
    """(..., 3) the entries of symmetric (..., 2, 2), as a vector of the same norm."""
    return np.stack([M[..., 0, 0], M[..., 1, 1], np.sqrt(2) * M[..., 0, 1]], axis=-1)


def _try_directions(count: int, knot: Index, P: Array, deficit: Array, toward: Array) -> Array:
    """(K, 3) the best of some directions by frame set. With m = P n, |m m' - L|^2 = |m|^4 - 2 m' L m + |L|^2."""
    tried = fibonacci_sphere(DIRECTIONS)
    order = np.argsort(knot, kind="stable")
    P, L, first = P[order], deficit[order], np.flatnonzero(np.diff(knot[order], prepend=-1))
    x, y = P[:, 0] @ tried.T, P[:, 1] @ tried.T
    across = L[:, 0, 0, None] * x**2 + 2 * L[:, 0, 1, None] * x * y + L[:, 1, 1, None] * y**2
    off = ((x**2 + y**2) ** 2 - 2 * across + (L**2).sum(axis=(1, 2))[:, None]) / SHAPE_SIGMA**2
    cost = np.minimum(off, SHAPE_LIMIT) + SHAPE_LIMIT * (toward[order] @ tried.T < 0)
    best = np.zeros(count, np.intp)
    best[knot[order][first]] = np.add.reduceat(cost, first).argmin(axis=1)
    return tried[best]


def _refine(normals: Array, knot: Index, P: Array, deficit: Array) -> Array:
    """One robust Gauss-Newton step of every normal in its tangent plane."""
    seed = np.where(np.abs(normals[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    e1 = np.cross(normals, seed)
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    plane = np.stack([e1, np.cross(normals, e1)], axis=2)
    Pn = np.einsum("nij,nj->ni", P, normals[knot])
    r, Pe = _entries(Pn[:, :, None] * Pn[:, None] - deficit), P @ plane[knot]
    J = np.stack(
        [_entries(Pe[:, :, k, None] * Pn[:, None] + Pn[:, :, None] * Pe[:, None, :, k]) for k in (0, 1)], 2
    )
    weight = 1 / (1 + (r**2).sum(axis=1) / SHAPE_SIGMA**2)
    A, g = np.zeros((len(normals), 2, 2)), np.zeros((len(normals), 2))
    np.add.at(A, knot, weight[:, None, None] * np.swapaxes(J, 1, 2) @ J)
    np.add.at(g, knot, weight[:, None] * np.einsum("nij,ni->nj", J, r))
    step = -np.linalg.solve(A + 1e-3 * np.eye(2), g[:, :, None])[:, :, 0]
    step *= np.minimum(1, 0.3 / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12))
    moved = normals + np.einsum("kij,kj->ki", plane, step)
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)
