# SPDX-License-Identifier: BSD-3-Clause
"""The roundels of one frame: as columns for computation, as objects for display."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from camera_node.foundation.arrays import Array

DIAMETERS_M = 0.001, 10.0  # of the black disc of a roundel that can be located


def _not_given() -> Array:
    return np.empty(0)


@dataclass(frozen=True, slots=True)
class Roundel:
    """One roundel in an image, in raw pixels.

    Attributes:
        uv: (2,) centre of the outer ellipse, which is not the image of the disc's own centre.
        cov: (2, 2) covariance of `uv`, square pixels.
        axes_px: (2,) full major and minor axis of the outer ellipse.
        angle_rad: direction of the major axis from +u towards +v, in (-pi/2, pi/2].
        ratio: inner over outer diameter.
        contrast: bright minus dark, grey levels of 255.
        id: the number of its code where that is certain, or one that a file gives; or None.
        track: number of the roundel in all frames in which it is tracked, or None.
        offset_px, pose_cov: as in `DetectedRoundels`; None unless a detector measured them.
        id_probability: of the code that was read; NaN where none was.
        rotation_rad, rotation_sigma: as in `Roundels`.
    """

    uv: Array
    cov: Array
    axes_px: Array
    angle_rad: float
    ratio: float
    contrast: float
    id: int | None = None
    track: int | None = None
    offset_px: Array | None = None
    pose_cov: Array | None = None
    id_probability: float = np.nan
    rotation_rad: float = np.nan
    rotation_sigma: float = np.nan


@dataclass(frozen=True, slots=True, eq=False)
class Roundels:
    """All roundels of one frame, as columns of N rows. `id` and `track` are -1 where there is none.

    Shapes: uv (N, 2), cov (N, 2, 2), axes_px (N, 2), and (N,) of all others. Unknown values are NaN, which columns that
    are not given contain.

    The zero of a code is seen on the outer ellipse at `uv` + A (cos, sin) of `rotation_rad`, where A is the symmetric
    matrix with half the axes; `rotation_sigma` is the standard deviation of that angle.
    """

    uv: Array
    cov: Array
    axes_px: Array
    angle_rad: Array
    ratio: Array
    contrast: Array
    id: NDArray[np.int32]
    track: NDArray[np.int32]
    id_probability: Array = field(default_factory=_not_given)
    rotation_rad: Array = field(default_factory=_not_given)
    rotation_sigma: Array = field(default_factory=_not_given)

    def __post_init__(self) -> None:
        for name in ("id_probability", "rotation_rad", "rotation_sigma"):
            if len(getattr(self, name)) != len(self.uv):
                object.__setattr__(self, name, np.full(len(self.uv), np.nan))

    @classmethod
    def from_points(
        cls, uv: Array, sigma_px: float | Array, id: NDArray[np.int32] | None = None
    ) -> "Roundels":
        """Detections with centres (N, 2) alone, each coordinate with the standard deviation `sigma_px`, () or (N,)."""
        uv = np.asarray(uv, float).reshape(-1, 2)
        n = len(uv)
        unknown, none = np.full(n, np.nan), np.full(n, -1, np.int32)
        cov = np.broadcast_to(sigma_px, n)[:, None, None] ** 2 * np.eye(2)
        return cls(
            uv, cov, np.full((n, 2), np.nan), unknown, unknown, unknown, none if id is None else id, none
        )

    def __len__(self) -> int:
        return len(self.uv)

    def select(self, rows: NDArray) -> "Roundels":
        """The rows that a mask or an index array selects."""
        return Roundels(*(getattr(self, name)[rows] for name in Roundels.__slots__))

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
            id_probability=float(self.id_probability[k]),
            rotation_rad=float(self.rotation_rad[k]),
            rotation_sigma=float(self.rotation_sigma[k]),
        )

    def __iter__(self) -> Iterator[Roundel]:
        return (self[k] for k in range(len(self)))


@dataclass(frozen=True, slots=True, eq=False)
class DetectedRoundels(Roundels):
    """The N roundels that a detector found in one image, with the measurements that only a fit to the image gives.

    Attributes:
        offset_px: (N, 2) vectors from the outer ellipses' centres `uv` to the images of the discs' own centres,
            measured by the position of the inner ellipse in the outer one.
        pose_cov: (N, 7, 7) covariance of the measurements of a pose, pixels: `uv`, the ellipse's shape as xx, xy, yy
            of A (the ellipse is `uv` + A q, |q| = 1, A symmetric), and the offset.
        n_postponed: positions in the image that may hold a roundel and were not fitted, because the work for a frame
            is bounded. The next frame begins with them. It is 0 unless the image has hundreds of untracked ring-like
            shapes.
    """

    offset_px: Array = field(kw_only=True)
    pose_cov: Array = field(kw_only=True)
    n_postponed: int = field(default=0, kw_only=True)

    def select(self, rows: NDArray) -> "DetectedRoundels":
        """The rows that a mask or an index array selects."""
        names = (*Roundels.__slots__, "offset_px", "pose_cov")
        columns = {name: getattr(self, name)[rows] for name in names}
        return DetectedRoundels(**columns, n_postponed=self.n_postponed)

    def __getitem__(self, k: int) -> Roundel:
        # Dataclasses with slots do not support super() without arguments.
        return replace(Roundels.__getitem__(self, k), offset_px=self.offset_px[k], pose_cov=self.pose_cov[k])


@dataclass(frozen=True, slots=True, eq=False)
class LocatedRoundels:
    """N roundels located by one camera, in its frame (OpenCV: z forward, y down), metres.

    Attributes:
        position: (N, 3) expected position of the disc's centre over both normals.
        cov: (N, 3, 3) covariance of `position`, with the distance between the positions of both normals; without
            errors of the lens and of the diameter.
        normals: (N, 2, 3) unit normals out of the printed side, the more probable one first. Both are equal where the
            image determines one.
        probability: (N, 2) of the normals.
        normal_sigma: (N, 2) standard deviation of each normal in its least certain direction, radians, to first order.
        axis_distance: (N,) distance by the principal axis, Section III-C of Faigl et al., ICRA 2013.
        id, track: (N,) as in `Roundels`.
    """

    position: Array
    cov: Array
    normals: Array
    probability: Array
    normal_sigma: Array
    axis_distance: Array
    id: NDArray[np.int32]
    track: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.position)
