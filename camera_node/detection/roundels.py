# SPDX-License-Identifier: BSD-3-Clause
"""What a detector sees in one frame: columns for programs, objects for people."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera_node.arrays import Array


@dataclass(frozen=True, slots=True)
class Roundel:
    """One roundel in an image, in raw pixels.

    Attributes:
        uv: (2,) centre of the outer ellipse. Where the disc's own centre projects is another point.
        cov: (2, 2) covariance of `uv`, square pixels.
        axes_px: (2,) full major and minor axis of the outer ellipse.
        angle_rad: direction of the major axis from +u towards +v, in (-pi/2, pi/2].
        ratio: inner over outer diameter.
        contrast: bright level less dark level, grey levels of 255.
        id: the number printed in the roundel or given by a file, or None.
        track: a number that stays with the roundel from frame to frame, or None.
    """

    uv: Array
    cov: Array
    axes_px: Array
    angle_rad: float
    ratio: float
    contrast: float
    id: int | None = None
    track: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Roundels:
    """All roundels of one frame, as columns of N rows. `id` and `track` are -1 where there is none.

    Shapes: uv (N, 2), cov (N, 2, 2), axes_px (N, 2), angle_rad, ratio, contrast, id and track (N,).
    What a source of detections does not know is NaN.
    """

    uv: Array
    cov: Array
    axes_px: Array
    angle_rad: Array
    ratio: Array
    contrast: Array
    id: NDArray[np.int32]
    track: NDArray[np.int32]

    @classmethod
    def from_points(cls, uv: Array, sigma_px: float, id: NDArray[np.int32] | None = None) -> "Roundels":
        """Detections of which only the centre (N, 2) is known, each coordinate to `sigma_px`."""
        uv = np.asarray(uv, float).reshape(-1, 2)
        n = len(uv)
        unknown, none = np.full(n, np.nan), np.full(n, -1, np.int32)
        cov = np.tile(sigma_px**2 * np.eye(2), (n, 1, 1))
        return cls(
            uv, cov, np.full((n, 2), np.nan), unknown, unknown, unknown, none if id is None else id, none
        )

    def __len__(self) -> int:
        return len(self.uv)

    def select(self, rows: NDArray) -> "Roundels":
        """The rows that a mask or an index array names."""
        return Roundels(*(getattr(self, name)[rows] for name in self.__slots__))

    def __getitem__(self, k: int) -> Roundel:
        number, track = int(self.id[k]), int(self.track[k])
        return Roundel(
            self.uv[k],
            self.cov[k],
            self.axes_px[k],
            float(self.angle_rad[k]),
            float(self.ratio[k]),
            float(self.contrast[k]),
            None if number < 0 else number,
            None if track < 0 else track,
        )

    def __iter__(self) -> Iterator[Roundel]:
        return (self[k] for k in range(len(self)))
