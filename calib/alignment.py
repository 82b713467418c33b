# SPDX-License-Identifier: BSD-3-Clause
"""The rigid motion between two sets of points (Kabsch; Umeyama 1991 without scale)."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rigid_motions(source: Array, target: Array) -> Array:
    """The motions (..., 4, 4) T that bring `source` (..., N, 3) nearest to `target`: target ~ T source."""
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
