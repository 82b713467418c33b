# SPDX-License-Identifier: BSD-3-Clause
"""Outlines of discs in the undistorted image plane, and their centres behind a lens with distortion.

The outline of a disc with centre c, unit normal n (camera frame) and radius r is an ellipse with the dual conic
c c' - r^2 (I - n n') (Hartley and Zisserman 2004, section 8.3); native/numeric/disc_outline.hpp has its equations. The
ellipse's centre is not the image of the disc's centre.

A lens is not linear across the outline of a disc, so the ellipse that a detector fits to the outline's image has
another centre than the image of the outline's centre. With the points m + M e of an ellipse, |e| = 1, and their images
p + J M (e + B(e, e) / 2), B the whitened second derivatives of the lens, least squares of the distances from the
circle move its centre by c = E[e (e . B(e, e))]. The fourth moments of the circle,
E[e_i e_k e_a e_b] = (d_ik d_ab + d_ia d_kb + d_ib d_ka) / 8, give

    c_i = (sum_a B_iaa + 2 sum_k B_kki) / 8.

With radial distortion k1 these are 3 k1 r^2 x for a disc of radius r at x in the image plane: 0.02 px for 24 px, 160 px
from the image's centre, and always towards it or away from it, so it does not average out.
"""

import numpy as np

from camera_node import _core
from camera_node.foundation.arrays import Array
from camera_node.geometry.lens import Lens

MAX_SHIFT = 0.3  # radii; where it is larger, the second derivatives do not describe the image


def disc_pictures(positions: Array, normals: Array) -> tuple[Array, Array, Array]:
    """Pictures of N discs in the image plane x/z, y/z, and their derivatives.

    Args:
        positions: (N, 3) centres over the discs' radii, camera frame.
        normals: (N, 3) unit vectors, camera frame.

    Returns:
        pictures: (N, 7) the outline's centre x, y and shape S as xx, xy, yy (its points are centre + S^(1/2) e,
            |e| = 1), and the image x, y of the disc's centre.
        J: (N, 7, 5) derivatives by the position, relative to the distance, and by the normal along `tangents`.
        tangents: (N, 3, 2) two unit vectors perpendicular to the normal and to each other.
    """
    return _core.disc_pictures(np.ascontiguousarray(positions, float), np.ascontiguousarray(normals, float))


def ellipses_of(dual: Array) -> Array:
    """Ellipses (..., 5) of dual conics (..., 3, 3): the centre x, y and the shape S as xx, xy, yy."""
    D = dual / dual[..., 2:, 2:]
    x, y = D[..., 0, 2], D[..., 1, 2]
    S = x * x - D[..., 0, 0], x * y - D[..., 0, 1], y * y - D[..., 1, 1]
    return np.stack([x, y, *S], axis=-1)


@np.errstate(all="ignore")  # outlines in messages may be unknown, or anything
def centre_shifts(lens: Lens, xy: Array, half_axes: Array) -> Array:
    """From the images of ellipses' centres to the centres of the ellipses that fit their images.

    Args:
        lens: that sees the ellipses.
        xy: (N, 2) centres in the undistorted image plane x/z, y/z.
        half_axes: (N, 2, 2) M: the points of the ellipse are xy + M e, |e| = 1.

    Returns:
        (N, 2) raw pixels; 0 where the lens or the ellipse is unknown (NaN), or the shift above `MAX_SHIFT`.
    """
    ends = xy[:, None] + np.concatenate([half_axes, -half_axes], axis=2).transpose(0, 2, 1)  # (N, 4, 2)
    points = np.concatenate([ends, np.ones((len(xy), 4, 1))], axis=2).reshape(-1, 3)
    points = np.nan_to_num(points, nan=-1.0, posinf=-1.0, neginf=-1.0)  # behind the camera
    J = lens.project_with_jacobian(points)[1][:, :, :2].reshape(-1, 4, 2, 2)
    image = J.mean(axis=1) @ half_axes
    change = (J[:, :2] - J[:, 2:]).transpose(0, 2, 3, 1) / 2  # of J along each half axis, the last index
    B = np.einsum("nklb,nla->nkab", change, half_axes)
    det = image[:, 0, 0] * image[:, 1, 1] - image[:, 0, 1] * image[:, 1, 0]
    adjugate = np.stack([image[:, 1, 1], -image[:, 0, 1], -image[:, 1, 0], image[:, 0, 0]], 1)
    B = np.einsum("nik,nkab->niab", adjugate.reshape(-1, 2, 2) / det[:, None, None], B)
    c = (np.einsum("niaa->ni", B) + 2 * np.einsum("nkki->ni", B)) / 8
    small = np.linalg.norm(c, axis=1) < MAX_SHIFT
    shifts = np.zeros((len(xy), 2))
    shifts[small] = np.einsum("nij,nj->ni", image[small], c[small])
    return shifts


@np.errstate(all="ignore")
def half_axes_of(axes_px: Array, angle_rad: Array) -> Array:
    """(N, 2, 2) half axes, as columns, of ellipses with full axes (N, 2) and directions (N,) of the first axis."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2) * axes_px[:, None] / 2
