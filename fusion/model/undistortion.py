# SPDX-License-Identifier: BSD-3-Clause
"""The inverse of a lens as a table: undistorting is exact but iterative, and every detection of every frame needs it.

The image is cut into cells; in each, both undistorted coordinates are polynomials of the third degree in the pixel's
place, fitted to the exact inverse. A cell where they miss it by `TOLERANCE_PX`, as near the edge of a fisheye, stays
empty, and what falls in there, or outside the image, is done by the lens itself.
"""

from functools import lru_cache

import numpy as np

from camera_node.arrays import Array, Mask
from camera_node.geometry.lens import Lens
from fusion import _core

CELL_PX, FINE_CELL_PX = 32, 16
ENOUGH = 0.99  # share of the cells that must be near the lens; else they are made finer
TOLERANCE_PX = 1e-3  # a hundredth of a good detection's noise
TOLERANCE_SCALE = 1e-3  # of the derivative, relative
POWERS = (
    (0, 0),
    (1, 0),
    (0, 1),
    (2, 0),
    (1, 1),
    (0, 2),
    (3, 0),
    (2, 1),
    (1, 2),
    (0, 3),
)  # of s and t, in a cell
NODES = np.cos(np.pi * (np.arange(4) + 0.5) / 4)  # Chebyshev's, of a fit's four samples a side
CHECKED = np.array([-1.0, 0.0, 1.0])  # where a cubic that was fitted at the nodes errs most


def undistort(lens: Lens, uv: Array) -> tuple[Array, Array]:
    """Undistorted coordinates of raw pixels, and how these move by them.

    Args:
        lens: of the camera that saw them.
        uv: (N, 2) raw pixels.

    Returns:
        xy: (2, N), within `TOLERANCE_PX` of `Lens.normalise`; NaN where the lens has no inverse.
        scale: (2, 2, N) the derivative of raw pixels by xy.
    """
    xy, scale = table_of(lens).look_up(uv)
    left = np.isnan(xy[0])
    if left.any():
        xy[:, left], scale[..., left] = _exactly(lens, uv[left])
    return xy, scale


@lru_cache(maxsize=256)
def table_of(lens: Lens) -> "UndistortionTable":
    """The lens's table, made once for all cameras and poses with these intrinsics: 30 to 150 ms."""
    return _table_of(Lens(**{name: getattr(lens, name) for name in Lens.__struct_fields__}))


@lru_cache(maxsize=256)
def _table_of(lens: Lens) -> "UndistortionTable":
    return UndistortionTable(lens)


class UndistortionTable:
    """A lens's cells, and a ring of empty ones around the image: `coefficients` (rows + 2, columns + 2, 20) of x and y.

    They are NaN in empty cells.
    """

    def __init__(self, lens: Lens) -> None:
        self.cell_px = CELL_PX
        fitted, near = _fit(lens, self.cell_px)
        if near < ENOUGH:
            self.cell_px = FINE_CELL_PX
            fitted, near = _fit(lens, self.cell_px)
        cells = fitted.reshape(*fitted.shape[:2], 2 * len(POWERS))
        self.coefficients = np.pad(cells, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)

    def look_up(self, uv: Array) -> tuple[Array, Array]:
        """(2, N) undistorted coordinates of pixels (N, 2), and (2, 2, N) pixels' derivatives by these; NaN if empty."""
        return _core.look_up(self.coefficients, self.cell_px, np.ascontiguousarray(uv))


def _monomials(st: Array) -> Array:
    """(10, N) the monomials of `POWERS` at s and t (2, N)."""
    M = np.empty((len(POWERS), st.shape[1]))
    M[0], M[1:3] = 1.0, st
    np.multiply(M[1:3], st[0], out=M[3:5])
    np.multiply(st[1], st[1], out=M[5])
    np.multiply(M[3:6], st[0], out=M[6:9])
    np.multiply(M[5], st[1], out=M[9])
    return M


def _derivative(axis: int) -> Array:
    """(10, 10) D: coefficients c of a polynomial are c @ D of its derivative by s (axis 0) or t."""
    D = np.zeros((len(POWERS), len(POWERS)))
    for k, power in enumerate(POWERS):
        if power[axis]:
            lower = (power[0] - 1, power[1]) if axis == 0 else (power[0], power[1] - 1)
            D[k, POWERS.index(lower)] = power[axis]
    return D


BY_S, BY_T = _derivative(0), _derivative(1)


def _fit(lens: Lens, cell_px: int) -> tuple[Array, float]:
    """(rows, columns, 2, 10) coefficients of x and y, NaN where they miss the lens; the share that does not."""
    samples, known = _samples(lens, cell_px, NODES)
    fit = np.asarray(np.linalg.pinv(_monomials(_square(NODES)).T), float)
    fitted = np.einsum("cs,rqsk->rqkc", fit, samples[..., :2])
    near = known & _is_near(fitted, lens, cell_px)
    fitted[~near] = np.nan
    return fitted, float(near.sum() / max(known.sum(), 1))


def _square(side: Array) -> Array:
    """(2, M * M) s and t of M by M points of a cell, from -1 to 1."""
    return np.array(np.meshgrid(side, side)).reshape(2, -1)


def _samples(lens: Lens, cell_px: int, side: Array) -> tuple[Array, Mask]:
    """(rows, columns, M * M, 6) the exact xy and derivatives at points of all cells; which cells know all of them."""
    rows, columns = -(-lens.height // cell_px), -(-lens.width // cell_px)
    s, t = _square(side)
    u = ((np.arange(columns)[:, None] + (s + 1) / 2) * cell_px - 0.5)[None]
    v = ((np.arange(rows)[:, None] + (t + 1) / 2) * cell_px - 0.5)[:, None]
    uv = np.stack(np.broadcast_arrays(u, v), -1)
    xy, scale = _exactly(lens, uv.reshape(-1, 2))
    values = np.concatenate([xy, scale.reshape(4, -1)]).T.reshape(*uv.shape[:3], 6)
    return values, np.isfinite(values.sum((2, 3)))


def _is_near(fitted: Array, lens: Lens, cell_px: int) -> Mask:
    """(rows, columns) cells whose polynomials are within the tolerances at points that they were not fitted to."""
    exact, known = _samples(lens, cell_px, CHECKED)
    at = _monomials(_square(CHECKED))
    xy, by_s, by_t = (np.einsum("rqkc,cs->rqsk", c, at) for c in (fitted, fitted @ BY_S, fitted @ BY_T))
    scale = exact[..., 2:].reshape(*xy.shape[:3], 2, 2)
    off_px = np.einsum("rqsij,rqsj->rqsi", scale, xy - exact[..., :2])
    off_scale = scale @ np.stack([by_s, by_t], -1) * (2 / cell_px) - np.eye(2)
    near = np.abs(off_px).max((2, 3)) < TOLERANCE_PX
    return known & near & (np.abs(off_scale).max((2, 3, 4)) < TOLERANCE_SCALE)


def _exactly(lens: Lens, uv: Array) -> tuple[Array, Array]:
    """(2, N) and (2, 2, N) of pixels (N, 2) by the lens itself."""
    xy = lens.normalise(uv)
    scale = lens.project_with_jacobian(np.column_stack([xy, np.ones(len(xy))]))[1][:, :, :2]
    return np.ascontiguousarray(xy.T), np.ascontiguousarray(scale.transpose(1, 2, 0))
