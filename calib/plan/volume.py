# SPDX-License-Identifier: BSD-3-Clause
"""The places of roundels in an arena: a grid of points, and connected regions of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from camera_node.foundation.arrays import Array, Mask

STEPS = (
    0.05,
    0.1,
    0.15,
    0.2,
    0.25,
    0.3,
    0.4,
    0.5,
    0.75,
    1.0,
    1.5,
    2.0,
    3.0,
    5.0,
    10.0,
)  # metres between grid points


@dataclass(frozen=True, slots=True)
class Volume:
    """A grid of points x (X,), y (Y,), z (Z,), ascending, metres; the points stand in the order of (Z, Y, X)."""

    x: Array
    y: Array
    z: Array

    @classmethod
    def covering(cls, low: ArrayLike, high: ArrayLike, points: int) -> "Volume":
        """The finest grid of round spacing over the box from `low` to `high` (3,) with at most about `points` points.

        The outermost points lie on the faces of the box. A box without height has one layer of points.
        """
        low, high = np.asarray(low, float), np.asarray(high, float)
        step = next((s for s in STEPS if np.prod(_counts(low, high, s)) <= points), STEPS[-1])
        counts = _counts(low, high, step)
        return cls(*(np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)))

    @property
    def shape(self) -> tuple[int, int, int]:
        """(Z, Y, X)."""
        return len(self.z), len(self.y), len(self.x)

    @property
    def points(self) -> Array:
        """(Z Y X, 3) the points, metres."""
        z, y, x = np.meshgrid(self.z, self.y, self.x, indexing="ij")
        return np.column_stack([x.ravel(), y.ravel(), z.ravel()])

    @property
    def cell_m(self) -> Array:
        """(3,) spacing along x, y and z; 0 where there is one layer."""
        return np.array([axis[1] - axis[0] if len(axis) > 1 else 0.0 for axis in (self.x, self.y, self.z)])


@dataclass(frozen=True, slots=True)
class Region:
    """A connected part of a volume: the box around its points, (3,) each, metres, and its share of the volume."""

    low: Array
    high: Array
    share: float

    def describe(self) -> str:
        """The box as text."""
        sides = zip("xyz", self.low, self.high, strict=True)
        box = ", ".join(f"{axis} {a:.2f}" + (f" to {b:.2f}" if b > a else "") for axis, a, b in sides)
        return f"{box} m ({self.share:.1%})"


def find_regions(volume: Volume, inside: Mask) -> list[Region]:
    """The connected regions of the points (N,) that are `inside`, largest first; neighbours share a coordinate line."""
    from scipy import ndimage

    labels = np.zeros(volume.shape, np.int32)
    ndimage.label(inside.reshape(volume.shape), output=labels)
    regions = []
    for k in range(1, int(np.max(labels, initial=0)) + 1):
        z, y, x = np.nonzero(labels == k)
        points = np.column_stack([volume.x[x], volume.y[y], volume.z[z]])
        regions.append(Region(points.min(axis=0), points.max(axis=0), len(points) / labels.size))
    return sorted(regions, key=lambda region: -region.share)


def _counts(low: Array, high: Array, step: float) -> Sequence[int]:
    return [int(np.ceil(side / step - 1e-9)) + 1 for side in high - low]
