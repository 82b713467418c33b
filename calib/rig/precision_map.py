# SPDX-License-Identifier: BSD-3-Clause
"""Maps the expected position error of points across the arena, in millimetres."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib.rig.camera import Camera
from calib.rig.triangulation import JointCovariance, Visibility, in_image, point_covariances
from camera_node.foundation.arrays import Array, Index

SIGMA_PX = 0.1  # of one coordinate of a roundel's centre, as the detector achieves on real images
COLUMNS = 8  # of a map, about
STEPS = (0.05, 0.1, 0.2, 0.25, 0.5, 1.0, 2.0, 5.0)  # metres between grid points


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
        grid = self.grid
        lines = [
            f"expected error in mm at z = {grid.z:.2f} m (1 sigma, worst axis, centres to {self.sigma_px:g} px):"
        ]
        for row in reversed(range(len(grid.y))):
            cells = "".join(f"{format_mm(value):>6}" for value in self.sigma_mm[row])
            lines.append(f"{grid.y[row]:>7.2f} |{cells}")
        lines.append(f"{'y / x':>7}  " + "".join(f"{x:>6.2f}" for x in grid.x))
        return lines


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
    sees: Visibility = in_image,
) -> PrecisionMap:
    """Predict the error of every grid point, from pixel noise and from the covariance of the cameras.

    Args:
        cameras: placed cameras.
        grid: the points, at the height of the robots' roundels.
        sigma_px: standard deviation of one coordinate of a roundel's centre, pixels.
        joint: covariance of all cameras together; by default independent poses and exact lenses.
        sees: the visibility test, which returns (N,) whether a camera sees each point.
    """
    points = grid.points
    covariance = point_covariances(cameras, points, sigma_px, joint, sees)
    known = np.isfinite(covariance).all(axis=(1, 2))
    sigma = np.full(len(covariance), np.inf)
    sigma[known] = 1e3 * np.sqrt(np.linalg.eigvalsh(covariance[known])[:, -1])
    views = np.array([sees(camera, points) for camera in cameras]).astype(np.intp).sum(axis=0)
    shape = (len(grid.y), len(grid.x))
    return PrecisionMap(grid, sigma_px, sigma.reshape(shape), views.reshape(shape))
