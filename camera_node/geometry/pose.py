# SPDX-License-Identifier: BSD-3-Clause
"""Poses as in YAML files (`position_m`, `wxyz`) and as 4x4 matrices, and conversions between forms of rotations.

`p_world = T_world_cam @ p_cam`: adjacent names cancel.
"""

import math

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from camera_node import _core
from camera_node.foundation.arrays import Array


class Pose(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A pose as in a YAML file: position in metres, and a quaternion w, x, y, z of any length except zero."""

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
    """(..., 4) unit quaternions w >= 0, x, y, z of rotations (..., 3, 3).

    Divides by the largest component (Shepperd 1978).
    """
    R = np.ascontiguousarray(R, float)
    return _core.quaternions(R.reshape(-1, 3, 3)).reshape(*R.shape[:-2], 4)


def rotation_from_vector(vectors: ArrayLike) -> Array:
    """(..., 3, 3) rotations by vectors (..., 3): axis times angle, radians.

    Rodrigues' formula: R = cos(a) I + sin(a)/a [w]x + (1 - cos(a))/a^2 w w^T, a = |w|.
    """
    w = np.asarray(vectors, float)
    angle = np.maximum(np.sqrt((w * w).sum(axis=-1, keepdims=True)), 1e-12)
    half = np.sin(angle / 2) / angle
    R = (2 * half * half * w)[..., :, None] * w[..., None, :]
    return R + (skew(np.sin(angle) / angle * w) + np.cos(angle)[..., None] * np.eye(3))


def vector_from_rotation(R: ArrayLike) -> Array:
    """(..., 3) vectors, axis times angle, of rotations (..., 3, 3); angles are in [0, pi] radians."""
    q = wxyz_from_rotation(R)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    return q[..., 1:] * (2 * np.arctan2(sine, q[..., :1]) / np.maximum(sine, 1e-12))


def rotation_angle(R: ArrayLike) -> float:
    """The angle of a rotation (3, 3), in [0, pi] radians."""
    return float(np.linalg.norm(vector_from_rotation(R)))


def rotation_with_z(z: ArrayLike) -> Array:
    """(..., 3, 3) rotations whose third columns are the unit vectors `z` (..., 3), and the first ones as near as
    possible to (1, 0, 0); arbitrary for `z` parallel to that."""
    z = np.asarray(z, float)
    y = np.cross(z, [1.0, 0.0, 0.0])
    length = np.linalg.norm(y, axis=-1, keepdims=True)
    y = np.where(length > 1e-9, y / np.maximum(length, 1e-9), [0.0, 1.0, 0.0])
    return np.stack([np.cross(y, z), y, z], axis=-1)


def motion_from(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """The (4, 4) rigid motion by a rotation, a matrix (3, 3) or a vector of three numbers, and a translation of three
    numbers, as OpenCV returns them."""
    R, T = np.asarray(rotation, float), np.eye(4)
    T[:3, :3] = R if R.shape == (3, 3) else rotation_from_vector(R.ravel())
    T[:3, 3] = np.ravel(translation)
    return T


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
    """(6, 6) adjoint of a (4, 4) rigid motion, for twists with rotation first: T Exp(xi) = Exp(Ad xi) T."""
    R, p = T[:3, :3], T[:3, 3]
    return np.block([[R, np.zeros((3, 3))], [skew(p) @ R, R]])


def look_at(position: ArrayLike, target: ArrayLike) -> Array:
    """T_world_cam (4, 4) of a camera at `position` that looks at `target`, with an upright image (world z up).

    Raises:
        ValueError: the target is exactly above or below the camera, where no upright image is defined.
    """
    position, target = np.asarray(position, float), np.asarray(target, float)
    z = target - position
    x = np.cross(z, [0.0, 0.0, 1.0])
    if np.linalg.norm(x) < 1e-9:
        raise ValueError("the camera's target is exactly above or below it; move one of them sideways")
    z, x = z / np.linalg.norm(z), x / np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    T[:3, 3] = position
    return T


def rigid_motions(source: Array, target: Array) -> Array:
    """(..., 4, 4) rigid motions T with the least squared distances between T `source` and `target`, both (..., N, 3).

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
