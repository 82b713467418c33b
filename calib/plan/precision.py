# SPDX-License-Identifier: BSD-3-Clause
"""What a rig can be expected to know of points across the arena: a map in millimetres."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.rig.camera import Camera
from calib.rig.triangulation import Joint, Sees, in_image, point_covariances
from camera_node.arrays import Array, Index

SIGMA_PX = 0.1  # of a roundel's centre: what the detector reaches in real pictures
COLUMNS = 8  # of a map, about
STEPS = (0.05, 0.1, 0.2, 0.25, 0.5, 1.0, 2.0, 5.0)  # metres between its points
CELL = 46  # pixels of a drawn one
INK, PAPER = (40, 35, 30), (252, 252, 250)


@dataclass(frozen=True, slots=True)
class PrecisionMap:
    """Expected errors of points on a grid at one height.

    Attributes:
        x, y: (X,) and (Y,) places of the grid, metres, ascending.
        z: the height, metres.
        sigma_px: standard deviation of a roundel's centre, pixels.
        sigma_mm: (Y, X) standard deviation along the worst axis; infinite where fewer than two cameras see.
        views: (Y, X) cameras that see.
    """

    x: Array
    y: Array
    z: float
    sigma_px: float
    sigma_mm: Array
    views: Index

    @property
    def points(self) -> Array:
        """(Y X, 3) the grid's points, row by row."""
        return grid_points(self.x, self.y, self.z)

    @property
    def typical_mm(self) -> float:
        """The median where two cameras or more see; infinite where none do."""
        known = self.sigma_mm[np.isfinite(self.sigma_mm)]
        return float(np.median(known)) if known.size else float("inf")

    @property
    def worst_mm(self) -> float:
        """The 95 % quantile of the same."""
        known = self.sigma_mm[np.isfinite(self.sigma_mm)]
        return float(np.quantile(known, 0.95)) if known.size else float("inf")

    @property
    def covered(self) -> float:
        """Part of the grid that two cameras or more see."""
        return float(np.isfinite(self.sigma_mm).mean())

    def lines(self) -> list[str]:
        """The map in text, north (y) up, a dot where fewer than two cameras see."""
        said = [
            f"expected error in mm at z = {self.z:.2f} m (1 sigma, worst axis, centres to {self.sigma_px:g} px):"
        ]
        for row in reversed(range(len(self.y))):
            cells = "".join(f"{_figure(value):>6}" for value in self.sigma_mm[row])
            said.append(f"{self.y[row]:>7.2f} |{cells}")
        said.append(f"{'y / x':>7}  " + "".join(f"{x:>6.2f}" for x in self.x))
        return said

    def draw(self, cameras: Mapping[str, Camera]) -> NDArray[np.uint8]:
        """The map as a picture (h, w, 3) BGR with the cameras around it."""
        return _draw(self, cameras)


def _figure(value: float) -> str:
    if not np.isfinite(value):
        return "·"
    return f"{value:.2f}" if value < 9.995 else f"{value:.0f}" if value < 1e4 else "far"


def map_precision(
    cameras: Sequence[Camera],
    low: ArrayLike,
    high: ArrayLike,
    z: float,
    sigma_px: float = SIGMA_PX,
    joint: Joint | None = None,
    sees: Sees = in_image,
) -> PrecisionMap:
    """The map of a rectangle (2,) to (2,) of the floor, at a height.

    Args:
        cameras: placed cameras, their covariances included where they have them.
        low, high: corners x, y, metres.
        z: the height at which robots carry their roundels, metres.
        sigma_px: standard deviation of a roundel's centre, pixels.
        joint: covariance of all cameras together; without it their poses count as independent.
        sees: which points a camera sees.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    step = next((s for s in STEPS if (high - low).max() / s <= COLUMNS), STEPS[-1])
    x, y = (
        np.arange(np.floor(a / step), np.ceil(b / step) + 1) * step for a, b in zip(low, high, strict=True)
    )
    grid = grid_points(x, y, z)
    covariance = point_covariances(cameras, grid, sigma_px, joint, sees)
    known = np.isfinite(covariance).all(axis=(1, 2))
    sigma = np.full(len(covariance), np.inf)
    sigma[known] = 1e3 * np.sqrt(np.linalg.eigvalsh(covariance[known])[:, -1])
    views = np.array([sees(camera, grid) for camera in cameras]).astype(np.intp).sum(axis=0)
    shape = (len(y), len(x))
    return PrecisionMap(x, y, z, sigma_px, sigma.reshape(shape), views.reshape(shape))


def grid_points(x: Array, y: Array, z: float) -> Array:
    """(Y X, 3) the points of a grid, row by row."""
    return np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), z)], axis=-1).reshape(-1, 3)


def _draw(told: PrecisionMap, cameras: Mapping[str, Camera]) -> NDArray[np.uint8]:
    rows, columns = told.sigma_mm.shape
    margin = 3 * CELL
    canvas = np.full((rows * CELL + 2 * margin, columns * CELL + 2 * margin, 3), PAPER, np.uint8)
    step = told.x[1] - told.x[0] if columns > 1 else 1.0
    best = max(float(np.min(told.sigma_mm)), 1e-6) if np.isfinite(told.sigma_mm).any() else 1.0
    for r in range(rows):
        for c in range(columns):
            at = np.array([margin + c * CELL, margin + (rows - 1 - r) * CELL])
            _cell(canvas, at, float(told.sigma_mm[r, c]), best)
    for name, camera in cameras.items():
        place = camera.matrix()[:2, 3]
        u = margin + ((place[0] - told.x[0]) / step + 0.5) * CELL
        v = margin + (rows - 0.5 - (place[1] - told.y[0]) / step) * CELL
        u, v = np.clip(u, 8, canvas.shape[1] - 8), np.clip(v, 36, canvas.shape[0] - 8)
        cv2.circle(canvas, (round(u), round(v)), 6, (200, 90, 20), -1, cv2.LINE_AA)
        room = canvas.shape[1] - u > 9 * len(name) + 12
        _write(canvas, name, (u + 9 if room else u - 9 * len(name) - 6, v + 4))
    for c, x in enumerate(told.x):
        _write(canvas, f"{x:.2f}", (margin + c * CELL + 5, margin + rows * CELL + 16))
    for r, y in enumerate(told.y):
        _write(canvas, f"{y:>5.2f}", (margin - 42, margin + (rows - r - 0.5) * CELL + 4))
    _write(canvas, "y / x, m", (margin - 42, margin + rows * CELL + 34))
    title = f"expected error, mm, at z = {told.z:.2f} m: {told.typical_mm:.2f} in the median"
    _write(canvas, title, (8, 18))
    return canvas


def _cell(canvas: np.ndarray, at: Array, value: float, best: float) -> None:
    share = min(np.log2(max(value / best, 1.0)) / 4, 1.0) if np.isfinite(value) else 1.0
    colour = (60 + 60 * share, 200 - 130 * share, 90 + 150 * share) if np.isfinite(value) else (225, 225, 225)
    corner = (int(at[0]) + CELL - 2, int(at[1]) + CELL - 2)
    cv2.rectangle(canvas, (int(at[0]), int(at[1])), corner, colour, -1)
    if np.isfinite(value):
        _write(canvas, _figure(value), (at[0] + 5, at[1] + CELL / 2 + 4))


def _write(canvas: np.ndarray, text: str, at: Sequence[float]) -> None:
    place = (round(float(at[0])), round(float(at[1])))
    cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, INK, 1, cv2.LINE_AA)
