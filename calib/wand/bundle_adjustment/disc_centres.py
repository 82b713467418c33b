# SPDX-License-Identifier: BSD-3-Clause
"""From ellipses' centres to discs' own centres.

Perspective moves the centre of a disc's image away from where the disc's centre is seen, by about D^2/(4f) sin t cos t
pixels for a disc of D pixels that is tilted by t: always towards the same side, so that it does not average out. The
shapes of all ellipses of a moment tell where the wand's printed side looks, as its markers all lie in one plane.
"""

import numpy as np

from calib.wand.bundle_adjustment.problem import WandObservations
from camera_node.arrays import Array, Index
from camera_node.geometry.lens import Lens
from camera_node.geometry.sphere import fibonacci_sphere

DIRECTIONS = 160  # of a sphere, tried before refinement: 9 degrees apart
SHAPE_SIGMA = 0.04  # of an ellipse's shape, in units of that of a disc seen straight
SHAPE_LIMIT = 9.0  # of one ellipse's squared misfit: a wrong one counts no more
STEPS = 4


def centre_offsets(
    lenses: list[Lens], cameras: Array, seen: WandObservations, points: Array, radius: float
) -> Array:
    """(n, 2) pixels from where a disc's centre is seen to its ellipse's centre; 0 where no ellipse of its moment tells.

    Args:
        lenses, cameras: of C cameras, (C, 4, 4) T_world_cam.
        points: (n, 3) where the discs are, world.
        radius: of the discs, metres.
    """
    offsets = np.zeros((len(seen), 2))
    local, P = _views(lenses, cameras, seen, points)
    known = (
        np.isfinite(seen.axes_px).all(axis=1) & np.isfinite(P).all(axis=(1, 2)) & (local[:, 2] > 2 * radius)
    )
    if not known.any():
        return offsets
    normals = _find_normals(cameras, seen.select(known), P[known], points[known], radius)
    rows = np.flatnonzero(np.isfinite(normals[seen.knot, 0]) & (local[:, 2] > 2 * radius))
    for c, lens in enumerate(lenses):
        mine = rows[seen.camera[rows] == c]
        normal = normals[seen.knot[mine]] @ cameras[c, :3, :3]
        offsets[mine] = np.nan_to_num(displacement(lens, local[mine], normal, radius))
    return offsets


def displacement(lens: Lens, points: Array, normals: Array, radius: float) -> Array:
    """(n, 2) pixels from the image of discs' centres to their ellipses' centres.

    The outline of a disc with centre c and normal n has the dual conic c c' - r^2 (I - n n') in the image plane, whose
    last column is the ellipse's centre (Hartley and Zisserman, sections 2.2.3 and 8.3).

    Args:
        points, normals: (n, 3) centres, metres, and unit normals, camera frame.
        radius: metres.
    """
    x, z, n = points[:, :2], points[:, 2:], normals
    centre = (x * z + radius**2 * n[:, :2] * n[:, 2:]) / (z**2 - radius**2 * (1 - n[:, 2:] ** 2))
    return lens.project(np.column_stack([centre, np.ones(len(centre))])) - lens.project(points)


def _views(lenses: list[Lens], cameras: Array, seen: WandObservations, points: Array) -> tuple[Array, Array]:
    """Points in their camera's frame (n, 3), and the derivative of pixels by world points (n, 2, 3)."""
    local, P = np.empty((len(seen), 3)), np.empty((len(seen), 2, 3))
    for c, lens in enumerate(lenses):
        rows, T = np.flatnonzero(seen.camera == c), cameras[c]
        local[rows] = (points[rows] - T[:3, 3]) @ T[:3, :3]
        P[rows] = lens.project_with_jacobian(local[rows])[1] @ T[:3, :3].T
    return local, P


def _find_normals(cameras: Array, seen: WandObservations, P: Array, points: Array, radius: float) -> Array:
    """(K, 3) unit normals by moment, world; NaN where no ellipse tells.

    A small disc's ellipse is r^2 P (I - n n') P', so what lacks to r^2 P P' is (P n)(P n)', whatever n's sign.
    """
    turn = np.stack([np.cos(seen.angle_rad), np.sin(seen.angle_rad)], axis=1)
    across = np.stack([-turn[:, 1], turn[:, 0]], axis=1)
    a, b = (seen.axes_px.T / 2) ** 2
    shape = a[:, None, None] * turn[:, :, None] * turn[:, None]
    shape += b[:, None, None] * across[:, :, None] * across[:, None]
    full = P @ np.swapaxes(P, 1, 2)
    unit = np.trace(full, axis1=1, axis2=2)
    lacking = (full - shape / radius**2) / unit[:, None, None]
    P = P / np.sqrt(unit)[:, None, None]
    toward = cameras[seen.camera, :3, 3] - points
    count = int(seen.knot.max()) + 1
    normals = _try_directions(count, seen.knot, P, lacking, toward)
    for _ in range(STEPS):
        normals = _refine(normals, seen.knot, P, lacking)
    normals[np.bincount(seen.knot, minlength=count) == 0] = np.nan
    return normals


def _entries(M: Array) -> Array:
    """(..., 3) the entries of symmetric (..., 2, 2), as a vector of the same norm."""
    return np.stack([M[..., 0, 0], M[..., 1, 1], np.sqrt(2) * M[..., 0, 1]], axis=-1)


def _try_directions(count: int, knot: Index, P: Array, lacking: Array, toward: Array) -> Array:
    """(K, 3) the best of some directions by moment. With m = P n, |m m' - L|^2 = |m|^4 - 2 m' L m + |L|^2."""
    tried = fibonacci_sphere(DIRECTIONS)
    order = np.argsort(knot, kind="stable")
    P, L, first = P[order], lacking[order], np.flatnonzero(np.diff(knot[order], prepend=-1))
    x, y = P[:, 0] @ tried.T, P[:, 1] @ tried.T
    across = L[:, 0, 0, None] * x**2 + 2 * L[:, 0, 1, None] * x * y + L[:, 1, 1, None] * y**2
    off = ((x**2 + y**2) ** 2 - 2 * across + (L**2).sum(axis=(1, 2))[:, None]) / SHAPE_SIGMA**2
    cost = np.minimum(off, SHAPE_LIMIT) + SHAPE_LIMIT * (toward[order] @ tried.T < 0)
    best = np.zeros(count, np.intp)
    best[knot[order][first]] = np.add.reduceat(cost, first).argmin(axis=1)
    return tried[best]


def _refine(normals: Array, knot: Index, P: Array, lacking: Array) -> Array:
    """One Gauss-Newton step of every normal in its tangent plane, ellipses that fit badly counting less."""
    seed = np.where(np.abs(normals[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    e1 = np.cross(normals, seed)
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    plane = np.stack([e1, np.cross(normals, e1)], axis=2)
    Pn = np.einsum("nij,nj->ni", P, normals[knot])
    r, Pe = _entries(Pn[:, :, None] * Pn[:, None] - lacking), P @ plane[knot]
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
