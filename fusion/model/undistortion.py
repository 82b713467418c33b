# SPDX-License-Identifier: BSD-3-Clause
"""Undistorts detections with a table of the inverse lens model, which is iterative and slow.

The table divides the image into cells. In each cell both undistorted coordinates are cubic polynomials of the pixel
coordinates, fitted to the exact inverse. Cells with errors above `TOLERANCE_PX` stay empty, for example at the edge of
a fisheye image. Pixels in empty cells or outside the image use the lens model.
"""

import math
from collections.abc import Iterable
from functools import lru_cache

import numpy as np

from camera_node.detection.roundels import Roundels
from camera_node.foundation.arrays import Array, Mask
from camera_node.geometry.lens import Lens
from camera_node.geometry.outline import centre_shifts, half_axes_of
from camera_node.protocol.messages import Detections
from fusion import _core

CELL_PX, FINE_CELL_PX = 32, 16
MAX_CELLS = 1 << 14  # of `CELL_PX`; larger images than 4096 x 4096 px have larger cells
ENOUGH = 0.99  # share of accurate cells; below it, the table uses the finer cells
TOLERANCE_PX = 1e-3  # 1 % of the noise of a good detection
TOLERANCE_SCALE = 1e-3  # relative, of the Jacobian
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
NODES = np.cos(np.pi * (np.arange(4) + 0.5) / 4)  # Chebyshev nodes of the four samples per side
CHECKED = np.array([-1.0, 0.0, 1.0])  # where a cubic fitted at the nodes has its largest errors


# Rows of the columns of detections; `DetectionTable` describes them.
UV, COV, OUTLINE, XY, SCALE = slice(2), slice(2, 6), slice(6, 9), slice(9, 11), slice(11, 15)
CODE, ROTATION, ROTATION_SIGMA, DELAY, N_ROWS = *range(15, 19), 19


def columns_of(detected: Detections | Roundels) -> Array:
    """(19, N) columns of a `DetectionTable` of N roundels, before `undistort`. A number without a probability comes
    from a file and is no code."""
    d = detected
    if isinstance(d, Detections):
        code = d.id, d.id_probability, d.rotation_rad, d.rotation_sigma
        return _core.detection_columns(d.uv, d.cov, d.axes_px, d.angle_rad, *code)
    columns = np.zeros((N_ROWS, len(d)))
    columns[UV], columns[COV], columns[OUTLINE] = d.uv.T, d.cov.reshape(-1, 4).T, (*d.axes_px.T, d.angle_rad)
    columns[CODE] = np.where(np.isfinite(d.id_probability), d.id, -1)
    columns[ROTATION], columns[ROTATION_SIGMA] = d.rotation_rad, d.rotation_sigma
    return columns


def undistort(lens: Lens, columns: Array, added_px2: float = TOLERANCE_PX**2) -> Array:
    """Undistort N roundels.

    Args:
        lens: lens model of the camera.
        columns: (19, N) of a `DetectionTable`, without the errors of cameras and without delays; their undistorted
            coordinates and Jacobians are written.
        added_px2: is added to the covariances, unless they contain it: the error of the table. Cameras may claim that
            they have hardly any, and equations with such weights are singular.

    Returns:
        the columns. Centres of the undistorted ellipses (`camera_node.geometry.outline`) are within `TOLERANCE_PX` of
        those by `Lens.normalise`; they are the undistorted centres where axes are unknown or impossible, and NaN where
        the lens has no inverse.
    """
    table = table_of(lens)
    if not _core.undistort(table.coefficients, table.cell_px, added_px2, columns):
        left = np.flatnonzero(np.isnan(columns[XY.start]))
        uv, outlines = columns[UV, left].T, columns[OUTLINE, left]
        xy, scale = undistort_exactly(lens, uv, half_axes_of(outlines[:2].T, outlines[2]))
        columns[XY, left], columns[SCALE, left] = xy, scale.reshape(4, -1)
    return columns


@np.errstate(all="ignore")  # as in `centre_shifts`
def undistort_exactly(lens: Lens, uv: Array, half_axes: Array) -> tuple[Array, Array]:
    """Centres (2, N) and Jacobians (2, 2, N) of pixels as of `undistort`, from the lens model, for ellipses with
    centres (N, 2) and half axes (N, 2, 2), pixels."""
    xy, scale = _undistort_points(lens, uv)
    known = np.flatnonzero(np.isfinite(xy[0]))
    if len(known):
        inverse = np.linalg.inv(scale.transpose(2, 0, 1)[known])
        shifts = centre_shifts(lens, xy.T[known], inverse @ half_axes[known])
        xy[:, known] -= np.einsum("nij,nj->in", inverse, shifts)  # to second order, the inverse lens's
    return xy, scale


@lru_cache(maxsize=256)
def table_of(lens: Lens) -> "UndistortionTable":
    """The cached table of a lens, shared by cameras with these intrinsics. The first call takes 30 to 150 ms."""
    return _table_of(Lens(**{name: getattr(lens, name) for name in Lens.__struct_fields__}))


@lru_cache(maxsize=256)
def _table_of(lens: Lens) -> "UndistortionTable":
    return UndistortionTable(lens)


def prepare_lenses(lenses: Iterable[Lens]) -> None:
    """Make the tables of lenses, so that `undistort` finds them; callable on any thread."""
    for lens in lenses:
        table_of(lens)


class UndistortionTable:
    """The cells of a lens, surrounded by a ring of empty cells.

    Attributes:
        coefficients: (rows + 2, columns + 2, 20) of x and y; NaN in empty cells.
        cell_px: the side of a cell.
    """

    def __init__(self, lens: Lens) -> None:
        larger = max(1, math.ceil(math.sqrt(lens.width * lens.height / MAX_CELLS) / CELL_PX))
        self.cell_px = larger * CELL_PX
        fitted, share = _fit(lens, self.cell_px)
        if share < ENOUGH:
            self.cell_px = larger * FINE_CELL_PX
            fitted, _ = _fit(lens, self.cell_px)
        cells = fitted.reshape(*fitted.shape[:2], 2 * len(POWERS))
        self.coefficients = np.pad(cells, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)


def _monomials(st: Array) -> Array:
    """(10, N) monomials of `POWERS` at s and t (2, N)."""
    M = np.empty((len(POWERS), st.shape[1]))
    M[0], M[1:3] = 1.0, st
    np.multiply(M[1:3], st[0], out=M[3:5])
    np.multiply(st[1], st[1], out=M[5])
    np.multiply(M[3:6], st[0], out=M[6:9])
    np.multiply(M[5], st[1], out=M[9])
    return M


def _derivative(axis: int) -> Array:
    """(10, 10) D: the derivative of a polynomial c by s (axis 0) or t (axis 1) has the coefficients c @ D."""
    D = np.zeros((len(POWERS), len(POWERS)))
    for k, power in enumerate(POWERS):
        if power[axis]:
            lower = (power[0] - 1, power[1]) if axis == 0 else (power[0], power[1] - 1)
            D[k, POWERS.index(lower)] = power[axis]
    return D


BY_S, BY_T = _derivative(0), _derivative(1)


def _fit(lens: Lens, cell_px: int) -> tuple[Array, float]:
    """(rows, columns, 2, 10) coefficients of x and y, NaN in inaccurate cells; and the share of accurate cells."""
    samples, known = _samples(lens, cell_px, NODES)
    fit = np.asarray(np.linalg.pinv(_monomials(_square(NODES)).T), float)
    fitted = np.einsum("cs,rqsk->rqkc", fit, samples[..., :2])
    accurate = known & _is_accurate(fitted, lens, cell_px)
    fitted[~accurate] = np.nan
    return fitted, float(accurate.sum() / max(known.sum(), 1))


def _square(side: Array) -> Array:
    """(2, M * M) s and t of an M x M grid in a cell, from -1 to 1."""
    return np.array(np.meshgrid(side, side)).reshape(2, -1)


def _samples(lens: Lens, cell_px: int, side: Array) -> tuple[Array, Mask]:
    """(rows, columns, M * M, 6) exact xy and Jacobians at grid points of all cells; and the cells with all of them."""
    rows, columns = -(-lens.height // cell_px), -(-lens.width // cell_px)
    s, t = _square(side)
    u = ((np.arange(columns)[:, None] + (s + 1) / 2) * cell_px - 0.5)[None]
    v = ((np.arange(rows)[:, None] + (t + 1) / 2) * cell_px - 0.5)[:, None]
    uv = np.stack(np.broadcast_arrays(u, v), -1)
    xy, scale = _undistort_points(lens, uv.reshape(-1, 2))
    values = np.concatenate([xy, scale.reshape(4, -1)]).T.reshape(*uv.shape[:3], 6)
    return values, np.isfinite(values.sum((2, 3)))


def _is_accurate(fitted: Array, lens: Lens, cell_px: int) -> Mask:
    """(rows, columns) cells whose polynomials are within the tolerances between the fitted points."""
    exact, known = _samples(lens, cell_px, CHECKED)
    at = _monomials(_square(CHECKED))
    xy, by_s, by_t = (np.einsum("rqkc,cs->rqsk", c, at) for c in (fitted, fitted @ BY_S, fitted @ BY_T))
    scale = exact[..., 2:].reshape(*xy.shape[:3], 2, 2)
    off_px = np.einsum("rqsij,rqsj->rqsi", scale, xy - exact[..., :2])
    off_scale = scale @ np.stack([by_s, by_t], -1) * (2 / cell_px) - np.eye(2)
    near = np.abs(off_px).max((2, 3)) < TOLERANCE_PX
    return known & near & (np.abs(off_scale).max((2, 3, 4)) < TOLERANCE_SCALE)


def _undistort_points(lens: Lens, uv: Array) -> tuple[Array, Array]:
    """(2, N) coordinates and (2, 2, N) Jacobians of pixels (N, 2), from the lens model."""
    xy = lens.normalise(uv)
    scale = lens.project_with_jacobian(np.column_stack([xy, np.ones(len(xy))]))[1][:, :, :2]
    return np.ascontiguousarray(xy.T), np.ascontiguousarray(scale.transpose(1, 2, 0))
