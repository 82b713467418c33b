# SPDX-License-Identifier: BSD-3-Clause
"""Maps of errors across the arena, in millimetres: the expected error of points, and the drawing of any such map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.rig.camera import Camera
from calib.rig.triangulation import JointCovariance, in_image, point_covariances
from camera_node.foundation.arrays import Array, Index

SIGMA_PX = 0.1  # of one coordinate of a roundel's centre, as the detector achieves on real images
COLUMNS = 8  # of a map, about
STEPS = (0.05, 0.1, 0.2, 0.25, 0.5, 1.0, 2.0, 5.0)  # metres between grid points
CELL = 46  # pixels of one grid cell
MARGIN = 3 * CELL
MIN_WIDTH = 560  # pixels of a map, for its title
INK, PAPER = (40, 35, 30), (252, 252, 250)
HIDDEN = (225, 225, 225)  # cells that fewer than two cameras see


@dataclass(frozen=True, slots=True)
class FloorGrid:
    """A regular grid of points at one height: x (X,) and y (Y,), ascending, and z, metres."""

    x: Array
    y: Array
    z: float

    @classmethod
    def covering(cls, low: ArrayLike, high: ArrayLike, z: float) -> "FloorGrid":
        """The grid over the rectangle from corner `low` (2,) to corner `high` (2,), metres, at height z."""
        low, high = np.asarray(low, float), np.asarray(high, float)
        step = next((s for s in STEPS if (high - low).max() / s <= COLUMNS), STEPS[-1])
        x, y = (
            np.arange(np.floor(a / step), np.ceil(b / step) + 1) * step
            for a, b in zip(low, high, strict=True)
        )
        return cls(x, y, z)

    @property
    def step(self) -> float:
        """Metres between neighbours; 1 if there is one point only."""
        return float(self.x[1] - self.x[0]) if len(self.x) > 1 else 1.0

    @property
    def points(self) -> Array:
        """(Y X, 3) the grid points, row by row."""
        height = np.full((len(self.y), len(self.x)), self.z)
        return np.stack([*np.meshgrid(self.x, self.y), height], axis=-1).reshape(-1, 3)


@dataclass(frozen=True, slots=True)
class PrecisionMap:
    """Expected errors of the points of a grid.

    Attributes:
        grid: the points.
        sigma_px: standard deviation of one coordinate of a roundel's centre, pixels.
        sigma_mm: (Y, X) standard deviation along the worst axis; infinite where fewer than two cameras see the point.
        views: (Y, X) number of cameras that see the point.
    """

    grid: FloorGrid
    sigma_px: float
    sigma_mm: Array
    views: Index

    @property
    def typical_mm(self) -> float:
        """Median where two cameras or more see; infinite if there is no such point."""
        return self._quantile(0.5)

    @property
    def worst_mm(self) -> float:
        """95 % quantile where two cameras or more see; infinite if there is no such point."""
        return self._quantile(0.95)

    def _quantile(self, q: float) -> float:
        known = self.sigma_mm[np.isfinite(self.sigma_mm)]
        return float(np.quantile(known, q)) if known.size else float("inf")

    @property
    def covered(self) -> float:
        """Fraction of the grid that two cameras or more see."""
        return float(np.isfinite(self.sigma_mm).mean())

    def lines(self) -> list[str]:
        """The map as text, north (y) up, with a dot where fewer than two cameras see."""
        height = f"z = {self.grid.z:.2f} m"
        title = f"expected error in mm at {height} (1 sigma, worst axis, centres to {self.sigma_px:g} px):"
        return [title, *error_rows(self.grid, self.sigma_mm)]


def error_rows(grid: FloorGrid, errors_mm: Array) -> list[str]:
    """Errors (Y, X) of a grid's points as lines of text, north (y) up, with a dot where an error is not finite."""
    rows = [
        f"{y:>7.2f} |" + "".join(f"{format_mm(value):>6}" for value in row)
        for y, row in zip(grid.y, errors_mm, strict=True)
    ]
    return [*reversed(rows), f"{'y / x':>7}  " + "".join(f"{x:>6.2f}" for x in grid.x)]


def format_mm(value: float) -> str:
    """An error in at most five characters."""
    if not np.isfinite(value):
        return "·"
    return f"{value:.2f}" if value < 9.995 else f"{value:.0f}" if value < 1e4 else "far"


def map_precision(
    cameras: Sequence[Camera],
    grid: FloorGrid,
    sigma_px: float = SIGMA_PX,
    joint: JointCovariance | None = None,
) -> PrecisionMap:
    """Predict the error of every grid point, from pixel noise and from the covariance of the cameras.

    Args:
        cameras: placed cameras.
        grid: the points, at the height of the robots' roundels.
        sigma_px: standard deviation of one coordinate of a roundel's centre, pixels.
        joint: covariance of all cameras together; by default independent poses and exact lenses.
    """
    points = grid.points
    covariance = point_covariances(cameras, points, sigma_px, joint)
    known = np.isfinite(covariance).all(axis=(1, 2))
    sigma = np.full(len(covariance), np.inf)
    sigma[known] = 1e3 * np.sqrt(np.linalg.eigvalsh(covariance[known])[:, -1])
    views = np.array([in_image(camera, points) for camera in cameras]).astype(np.intp).sum(axis=0)
    shape = (len(grid.y), len(grid.x))
    return PrecisionMap(grid, sigma_px, sigma.reshape(shape), views.reshape(shape))


def draw_precision(precision: PrecisionMap, cameras: Mapping[str, Camera]) -> NDArray[np.uint8]:
    """Draw the map as an image (h, w, 3) BGR, with placed cameras by name."""
    title = f"expected error, mm, at z = {precision.grid.z:.2f} m: {precision.typical_mm:.2f} in the median"
    return draw_errors(precision.grid, precision.sigma_mm, title, cameras)


def draw_errors(
    grid: FloorGrid, errors_mm: Array, title: str, cameras: Mapping[str, Camera]
) -> NDArray[np.uint8]:
    """Draw errors (Y, X) of a grid's points, mm, as an image (h, w, 3) BGR, with placed cameras by name.

    A point whose error is not finite is grey.
    """
    rows, columns = errors_mm.shape
    size = rows * CELL + 2 * MARGIN, max(columns * CELL + 2 * MARGIN, MIN_WIDTH)
    canvas = np.full((*size, 3), PAPER, np.uint8)
    _draw_cells(canvas, errors_mm)
    _draw_cameras(canvas, grid, cameras)
    _draw_axes(canvas, grid)
    _draw_text(canvas, title, (8, 18))
    return canvas


def _draw_cells(canvas: np.ndarray, errors_mm: Array) -> None:
    best = max(float(np.min(errors_mm)), 1e-6) if np.isfinite(errors_mm).any() else 1.0
    for (row, column), value in np.ndenumerate(errors_mm):
        u, v = MARGIN + column * CELL, MARGIN + (len(errors_mm) - 1 - row) * CELL
        share = min(np.log2(max(value / best, 1.0)) / 4, 1.0) if np.isfinite(value) else 1.0
        colour = (60 + 60 * share, 200 - 130 * share, 90 + 150 * share) if np.isfinite(value) else HIDDEN
        cv2.rectangle(canvas, (u, v), (u + CELL - 2, v + CELL - 2), colour, -1)
        if np.isfinite(value):
            _draw_text(canvas, format_mm(value), (u + 5, v + CELL / 2 + 4))


def _draw_cameras(canvas: np.ndarray, grid: FloorGrid, cameras: Mapping[str, Camera]) -> None:
    for name, camera in cameras.items():
        position: Array = camera.matrix()[:2, 3]
        u = MARGIN + ((position[0] - grid.x[0]) / grid.step + 0.5) * CELL
        v = MARGIN + (len(grid.y) - 0.5 - (position[1] - grid.y[0]) / grid.step) * CELL
        u, v = np.clip(u, 8, canvas.shape[1] - 8), np.clip(v, 36, canvas.shape[0] - 8)
        cv2.circle(canvas, (round(u), round(v)), 6, (200, 90, 20), -1, cv2.LINE_AA)
        fits_right = canvas.shape[1] - u > 9 * len(name) + 12
        _draw_text(canvas, name, (u + 9 if fits_right else u - 9 * len(name) - 6, v + 4))


def _draw_axes(canvas: np.ndarray, grid: FloorGrid) -> None:
    bottom = canvas.shape[0] - MARGIN
    for column, x in enumerate(grid.x):
        _draw_text(canvas, f"{x:.2f}", (MARGIN + column * CELL + 5, bottom + 16))
    for row, y in enumerate(grid.y):
        _draw_text(canvas, f"{y:>5.2f}", (MARGIN - 42, bottom - (row + 0.5) * CELL + 4))
    _draw_text(canvas, "y / x, m", (MARGIN - 42, bottom + 34))


def _draw_text(canvas: np.ndarray, text: str, at: Sequence[float]) -> None:
    place = (round(float(at[0])), round(float(at[1])))
    cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, INK, 1, cv2.LINE_AA)
