# SPDX-License-Identifier: BSD-3-Clause
"""What all cameras saw of the wand, as columns: one row a detection, frames and cameras by number."""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from camera_node.arrays import Array, Index
from camera_node.geometry.lens import Lens
from camera_node.protocol.messages import Detections

UNKNOWN_S = 1.0  # more than cameras' clocks may be apart
HEADER = ("camera", "t_ns", "clock_error_us")
# Of a message: what its columns hold, and how many of them a roundel has (`Detections`).
COLUMNS = {
    "uv": ("<f8", 2),
    "cov": ("<f4", 3),
    "axes_px": ("<f4", 2),
    "angle_rad": ("<f4", 1),
    "id": ("<i4", 1),
}


class Ellipses(Protocol):
    """Columns of detections with their ellipses, as `WandDetections` has them."""

    @property
    def camera(self) -> Index: ...
    @property
    def uv(self) -> Array: ...
    @property
    def axes_px(self) -> Array: ...
    @property
    def angle_rad(self) -> Array: ...


@dataclass(frozen=True, slots=True)
class FrameTable:
    """All frames of a recording, by camera, then by time.

    Attributes:
        camera: (F,) index of the camera.
        t_s: (F,) stamp of the middle of the exposure, seconds after `origin_ns`.
        origin_ns: the first stamp.
    """

    camera: Index
    t_s: Array
    origin_ns: int

    def period_s(self) -> float:
        """The median time from one frame of a camera to its next; 0 where no camera has two."""
        steps = np.diff(self.t_s)[(np.diff(self.camera) == 0) & (np.diff(self.t_s) > 0)]
        return float(np.median(steps)) if len(steps) else 0.0


@dataclass(frozen=True, slots=True)
class WandDetections:
    """Detections, sorted by frame.

    Attributes:
        camera, frame: (n,) where a detection is from.
        t_s: (n,) stamp of its frame, seconds.
        stamp_sigma_s: (n,) standard deviation of that, beside the offset that a camera's stamps share.
        label: (n,) marker of the wand; -1 where it is not known.
        uv: (n, 2) centre of the ellipse, raw pixels.
        cov: (n, 2, 2) its covariance, square pixels.
        axes_px, angle_rad: (n, 2) full axes and (n,) direction of the ellipse; NaN where not known.
        xy: (n, 2) undistorted image plane coordinates of `uv`.
    """

    camera: Index
    frame: Index
    t_s: Array
    stamp_sigma_s: Array
    label: Index
    uv: Array
    cov: Array
    axes_px: Array
    angle_rad: Array
    xy: Array

    def __len__(self) -> int:
        return len(self.uv)

    def select(self, rows: NDArray) -> "WandDetections":
        """The rows that a mask or an index array names."""
        return WandDetections(*(getattr(self, name)[rows] for name in self.__slots__))

    def rays(self) -> Array:
        """(n, 3) unit viewing rays, camera frames."""
        rays = np.column_stack([self.xy, np.ones(len(self))])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def gather(messages: Sequence[Detections], names: Sequence[str], lenses: Sequence[Lens]):
    """Frames and sightings of the cameras `names`, their labels the numbers that the detections carry.

    Detections outside of what a lens model covers are left out.

    Returns:
        frames, sightings
    """
    index = {name: k for k, name in enumerate(names)}
    messages = sorted(messages, key=lambda message: (index[message.camera], message.t_ns))
    camera_of, t_ns, bound_us, *columns = zip(*map(attrgetter(*HEADER, *COLUMNS), messages), strict=True)
    origin_ns = min(t_ns)
    camera = np.array([index[name] for name in camera_of], np.intp)
    t_s = (np.array(t_ns) - origin_ns) * 1e-9
    tables = [_table(data, *shape) for data, shape in zip(columns, COLUMNS.values(), strict=True)]
    uv, cov, axes_px, angle_rad, number = tables
    frame = np.repeat(np.arange(len(messages)), [len(data) // 16 for data in columns[0]])
    xy = np.full(uv.shape, np.nan)
    for k, lens in enumerate(lenses):
        mine = camera[frame] == k
        xy[mine] = lens.normalise(uv[mine])
    every = WandDetections(
        camera[frame],
        frame,
        t_s[frame],
        stamp_sigmas(camera, 1e-6 * np.array(bound_us))[frame],
        number[:, 0].astype(np.intp),
        uv,
        cov[:, [0, 1, 1, 2]].reshape(-1, 2, 2),
        axes_px,
        angle_rad[:, 0],
        xy,
    )
    return FrameTable(camera, t_s, origin_ns), every.select(np.flatnonzero(np.isfinite(xy).all(axis=1)))


def stamp_sigmas(camera: Index, bound_s: Array) -> Array:
    """Standard deviations (F,) of frames' stamps, seconds, beside the offset that is sought for each camera.

    What the least bound of a camera leaves open may be the same in all its frames, and is the offset's. Within what
    another is wider by, all is equally likely. A frame of before the server's first answer has a stamp of any clock.
    """
    bound_s = np.nan_to_num(bound_s, nan=UNKNOWN_S)
    least = np.full(camera.max() + 1, np.inf)
    np.minimum.at(least, camera, bound_s)
    return (bound_s - least[camera]) / np.sqrt(3)


def _table(data: Sequence[bytes], dtype: str, width: int) -> Array:
    return np.frombuffer(b"".join(data), dtype).reshape(-1, width).astype(float)


def ranges(lenses: Sequence[Lens], seen: Ellipses, diameter_m: float) -> Array:
    """Distances (n,) of discs, metres, from the angle under which their major axis appears.

    A disc of diameter d at distance r, seen at any tilt, appears under the angle 2 atan(d / 2r) along its major axis.
    NaN where the detection has no axes.
    """
    along = np.column_stack([np.cos(seen.angle_rad), np.sin(seen.angle_rad)])
    half = seen.axes_px[:, :1] / 2 * along
    distances = np.full(len(seen.uv), np.nan)
    for k, lens in enumerate(lenses):
        rows = np.flatnonzero((seen.camera == k) & np.isfinite(half).all(axis=1))
        if len(rows):
            a, b = lens.rays(seen.uv[rows] - half[rows]), lens.rays(seen.uv[rows] + half[rows])
            apart = np.maximum(np.linalg.norm(a - b, axis=1), 1e-12)
            distances[rows] = diameter_m / apart * np.linalg.norm(a + b, axis=1) / 2
    return distances


def frame_counts(seen: WandDetections, cameras: int) -> list[int]:
    """The number of frames with sightings, by camera."""
    first = np.flatnonzero(np.diff(seen.frame, prepend=-1))
    return np.bincount(seen.camera[first], minlength=cameras).tolist()
