# SPDX-License-Identifier: BSD-3-Clause
"""Counts points in the cells of an image, and names the regions of the image that have few."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.foundation.arrays import Array, Index, Mask

CELLS = (6, 8)  # rows and columns of the grid
REGIONS = (
    ("upper left", "upper middle", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "lower middle", "lower right"),
)
MIN_SHARE = 1 / 3  # of a region's cells: a region with a smaller used share is reported as missing


@dataclass(frozen=True, slots=True)
class Coverage:
    """Number of points in each cell of an image: `counts` (rows, columns), upper left first."""

    counts: NDArray[np.int64]

    @classmethod
    def of(cls, uv: ArrayLike, width: int, height: int, cells: tuple[int, int] = CELLS) -> "Coverage":
        """Count pixels (N, 2); pixels outside of the image or not finite are ignored."""
        uv = np.asarray(uv, float).reshape(-1, 2)
        edges = [[-0.5, height - 0.5], [-0.5, width - 0.5]]
        finite = uv[np.isfinite(uv).all(axis=1)]
        return cls(np.histogram2d(finite[:, 1], finite[:, 0], cells, edges)[0].astype(np.int64))

    def __add__(self, other: "Coverage") -> "Coverage":
        return Coverage(self.counts + other.counts)

    @property
    def used(self) -> Mask:
        """(rows, columns) the cells with at least one point."""
        return self.counts > 0

    def share(self, useful: Mask | None = None) -> float:
        """Used fraction of all cells, or of the `useful` cells (rows, columns); 1 if no cell is useful."""
        cells = self.used if useful is None else self.used[useful]
        return float(cells.mean()) if cells.size else 1.0

    def missing(self, useful: Mask | None = None) -> list[str]:
        """Names of the regions with few used cells, emptiest first; regions with few `useful` cells are skipped."""
        wanted = np.ones(self.counts.shape, bool) if useful is None else useful
        shares: dict[str, float] = {}
        for name, part in regions(self.counts.shape):
            if wanted[part].mean() >= 0.5:
                shares[name] = float(self.used[part][wanted[part]].mean())
        return sorted((name for name in shares if shares[name] < MIN_SHARE), key=shares.__getitem__)


def spread_evenly(count: int, most: int) -> Index:
    """Up to `most` indices below `count`, evenly spaced."""
    return np.linspace(0, count - 1, min(most, count)).round().astype(np.intp)


def choose_covering(counts: Array, most: int, first: Sequence[int] | Index = ()) -> Mask:
    """(n,) at most `most` of n parts that together fill all cells evenly, from their points (n, cells) in each.

    Greedy: after the parts `first`, each next one is that with most points in cells that have few so far.
    """
    chosen = np.zeros(len(counts), bool)
    chosen[list(first)] = True
    filled = counts[chosen].sum(axis=0)
    for _ in range(min(most, len(counts)) - int(chosen.sum())):
        best = int(np.where(chosen, -1.0, counts @ (1 / (1 + filled))).argmax())
        filled += counts[best]
        chosen[best] = True
    return chosen


def regions(shape: tuple[int, ...]) -> list[tuple[str, tuple[slice, slice]]]:
    """The nine regions of a grid of cells: name, and slices of rows and columns."""
    rows, columns = (np.linspace(0, n, 4).round().astype(int) for n in shape)
    return [
        (REGIONS[r][c], (slice(rows[r], rows[r + 1]), slice(columns[c], columns[c + 1])))
        for r in range(3)
        for c in range(3)
    ]


def region_of(uv: ArrayLike, width: int, height: int) -> str:
    """The name of the region of the image in which a pixel (2,) lies."""
    u, v = np.asarray(uv, float)
    row, column = (int(np.clip(3 * (x + 0.5) / n, 0, 2)) for x, n in ((v, height), (u, width)))
    return REGIONS[row][column]


def enumerate_words(words: list[str]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def cell_centres(width: int, height: int, cells: tuple[int, int] = CELLS) -> Array:
    """(rows * columns, 2) the pixel at the centre of each cell."""
    rows, columns = cells
    v, u = np.mgrid[0:rows, 0:columns]
    return np.column_stack(
        [(u.ravel() + 0.5) * width / columns - 0.5, (v.ravel() + 0.5) * height / rows - 0.5]
    )
