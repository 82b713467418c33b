# SPDX-License-Identifier: BSD-3-Clause
"""Poses as people write them (`position_m`, `wxyz`) and as mathematics uses them (a 4x4 matrix).

`p_world = T_world_cam @ p_cam`: adjacent names cancel.
"""

import math

import cv2
import msgspec
import numpy as np
from numpy.typing import ArrayLike

from camera_node.arrays import Array


class Pose(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A rigid motion as it stands in a YAML file: metres, and a quaternion w, x, y, z of any length but zero."""

    position_m: tuple[float, float, float]
    wxyz: tuple[float, float, float, float]

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (*self.position_m, *self.wxyz))):
            raise ValueError("a pose must be finite")
        if math.hypot(*self.wxyz) < 1e-6:
            raise ValueError("the quaternion wxyz must not be zero")

    def matrix(self) -> Array:
        """The (4, 4) homogeneous matrix."""
        T = np.eye(4)
        T[:3, :3] = rotation_from_wxyz(self.wxyz)
        T[:3, 3] = self.position_m
        return T

    @classmethod
    def from_matrix(cls, T: ArrayLike) -> "Pose":
        """The pose of a (4, 4) homogeneous matrix."""
        T = np.asarray(T, float)
        return cls(tuple(T[:3, 3].tolist()), tuple(wxyz_from_rotation(T[:3, :3]).tolist()))


def rotation_from_wxyz(wxyz: ArrayLike) -> Array:
    """(..., 3, 3) rotations of quaternions w, x, y, z (..., 4) of any length: I + 2 w [v]x + 2 [v]x^2 of unit ones."""
    q = np.asarray(wxyz, float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    W = skew(q[..., 1:])
    return np.eye(3) + 2 * q[..., :1, None] * W + 2 * W @ W


def wxyz_from_rotation(R: ArrayLike) -> Array:
    """(4,) unit quaternion w >= 0, x, y, z of a (3, 3) rotation (Shepperd's largest component first)."""
    R = np.asarray(R, float)
    squares = 1 + np.array([np.trace(R), *(2 * np.diag(R) - np.trace(R))])
    k = int(np.argmax(squares))
    a, b, c = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    d, e, f = R[1, 0] + R[0, 1], R[0, 2] + R[2, 0], R[2, 1] + R[1, 2]
    s = squares[k]
    q = np.array([[s, a, b, c], [a, s, d, e], [b, d, s, f], [c, e, f, s]][k])
    return np.copysign(1.0, q[0]) * q / np.linalg.norm(q)


def rotation_from_vector(omega: ArrayLike) -> Array:
    """(3, 3) rotation by the vector `omega` (3,): axis times angle, radians."""
    return np.asarray(cv2.Rodrigues(np.asarray(omega, float).reshape(3, 1))[0], float)


def invert(T: Array) -> Array:
    """The inverse of a (4, 4) rigid motion."""
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse


def skew(vectors: ArrayLike) -> Array:
    """(..., 3, 3) matrices [v]x of vectors (..., 3): [v]x w = v x w."""
    v = np.asarray(vectors, float)
    W = np.zeros((*v.shape, 3))
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return W - np.swapaxes(W, -1, -2)


def adjoint(T: Array) -> Array:
    """(6, 6) how a (4, 4) rigid motion carries a twist, rotation first: T Exp(xi) = Exp(Ad xi) T."""
    R, p = T[:3, :3], T[:3, 3]
    return np.block([[R, np.zeros((3, 3))], [skew(p) @ R, R]])


def look_at(position: ArrayLike, target: ArrayLike) -> Array:
    """T_world_cam (4, 4) of a camera at `position` that looks at `target`, its image upright (world z up).

    Raises:
        ValueError: the target stands straight above or below the camera, where upright has no meaning.
    """
    position, target = np.asarray(position, float), np.asarray(target, float)
    z = target - position
    x = np.cross(z, [0.0, 0.0, 1.0])
    if np.linalg.norm(x) < 1e-9:
        raise ValueError("the target stands straight above or below the camera")
    z, x = z / np.linalg.norm(z), x / np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    T[:3, 3] = position
    return T


def rigid_motions(source: Array, target: Array) -> Array:
    """The motions (..., 4, 4) T that bring `source` (..., N, 3) nearest to `target`: target ~ T source.

    Kabsch 1976; Umeyama 1991 without scale.
    """
    a, b = source.mean(axis=-2, keepdims=True), target.mean(axis=-2, keepdims=True)
    U, _, Vt = np.linalg.svd(np.swapaxes(target - b, -1, -2) @ (source - a))
    D = np.zeros(U.shape)
    D[..., 0, 0] = D[..., 1, 1] = 1.0
    D[..., 2, 2] = np.linalg.det(U @ Vt)
    T = np.zeros((*U.shape[:-2], 4, 4))
    T[..., :3, :3] = U @ D @ Vt
    T[..., :3, 3] = (b - a @ np.swapaxes(T[..., :3, :3], -1, -2))[..., 0, :]
    T[..., 3, 3] = 1.0
    return T


def exp_so3(vectors: Array) -> Array:
    """(N, 3, 3) rotations by vectors (N, 3)."""
    return np.ascontiguousarray(turns(vectors.T).transpose(2, 0, 1))


def log_so3(R: Array) -> Array:
    """(N, 3) vectors of rotations (N, 3, 3) of less than half a turn: the quaternion's."""
    q = wxyz_of(R)
    sine = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2 * np.arctan2(sine, q[:, 0])
    return q[:, 1:] * (angle / np.maximum(sine, 1e-12))[:, None]


def turns(w: Array) -> Array:
    """(3, 3, ...) rotations by vectors (3, ...).

    Rodrigues' formula: R = cos(a) I + sin(a)/a [w]x + (1 - cos(a))/a^2 w w^T, a = |w|.
    """
    angle = np.maximum(np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]), 1e-12)
    cosine, s, half = np.cos(angle), np.sin(angle) / angle * w, np.sin(angle / 2) / angle
    R = (2 * half * half * w)[:, None] * w
    R[0, 0] += cosine
    R[1, 1] += cosine
    R[2, 2] += cosine
    R[0, 1] -= s[2]
    R[1, 0] += s[2]
    R[0, 2] += s[1]
    R[2, 0] -= s[1]
    R[1, 2] -= s[0]
    R[2, 1] += s[0]
    return R


def wxyz_of(R: Array) -> Array:
    """(N, 4) unit quaternions w >= 0, x, y, z of rotations (N, 3, 3) (Shepperd's largest component first)."""
    diagonal = np.einsum("nii->ni", R)
    trace = diagonal.sum(1, keepdims=True)
    largest = np.argmax(np.concatenate([trace, 2 * diagonal - trace], 1), axis=1)
    a, b, c = (R[:, [2, 0, 1], [1, 2, 0]] - R[:, [1, 2, 0], [2, 0, 1]]).T
    d, e, f = (R[:, [1, 0, 2], [0, 2, 1]] + R[:, [0, 2, 1], [1, 0, 2]]).T
    s = 1 + np.concatenate([trace, 2 * diagonal - trace], 1).T
    rows = np.array([[s[0], a, b, c], [a, s[1], d, e], [b, d, s[2], f], [c, e, f, s[3]]])
    q = rows[largest, :, np.arange(len(R))]
    return np.where(q[:, :1] < 0, -1.0, 1.0) * q / np.linalg.norm(q, axis=1, keepdims=True)
