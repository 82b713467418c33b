# SPDX-License-Identifier: BSD-3-Clause
"""The detections of all cameras as columns: one row per detection, frames and cameras by index."""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib.rig.camera import Camera
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.lens import Lens
from camera_node.geometry.outline import RawEllipses
from camera_node.protocol.messages import Detections

MAX_CLOCK_ERROR_S = 1.0  # bound for a timestamp without a clock error: above any difference of camera clocks
HEADER = ("camera", "t_ns", "clock_error_us", "readout_us")
# Columns of a `Detections` message: element type, and elements per roundel.
COLUMNS = {
    "uv": ("<f8", 2),
    "cov": ("<f4", 3),
    "axes_px": ("<f4", 2),
    "angle_rad": ("<f4", 1),
    "id": ("<i4", 1),
}


class Ellipses(RawEllipses, Protocol):
    """Detections with ellipses and their cameras, as columns (see `WandDetections`)."""

    @property
    def camera(self) -> Index: ...


@dataclass(frozen=True, slots=True)
class FrameTable:
    """All frames of a recording, sorted by camera, then by time.

    Attributes:
        camera: (F,) index of the camera.
        t_s: (F,) timestamp of the middle of the exposure, seconds after the first frame.
        readout_s: (F,) given readout time, seconds; 0 of a global shutter or if unknown.
    """

    camera: Index
    t_s: Array
    readout_s: Array

    def period_s(self) -> float:
        """Return the median time between consecutive frames of a camera, seconds; 0 if no camera has two."""
        steps = np.diff(self.t_s)[(np.diff(self.camera) == 0) & (np.diff(self.t_s) > 0)]
        return float(np.median(steps)) if len(steps) else 0.0


@dataclass(frozen=True, slots=True)
class WandDetections:
    """Detections, sorted by frame.

    Attributes:
        camera, frame: (n,) indices of the camera and of the frame.
        t_s: (n,) timestamp of the frame, seconds; of the detection's row where the readout time is given.
        image_row: (n,) height in the image, -1/2 to 1/2 (`Lens.image_row`).
        stamp_sigma_s: (n,) standard deviation of the timestamp, without the offset common to the camera's timestamps.
        label: (n,) marker of the wand, -1 if unknown.
        uv: (n, 2) centre of the ellipse, raw pixels.
        cov: (n, 2, 2) covariance of the centre, square pixels.
        axes_px, angle_rad: (n, 2) full axes and (n,) direction of the ellipse; NaN if unknown.
        xy: (n, 2) undistorted image plane coordinates of `uv`.
    """

    camera: Index
    frame: Index
    t_s: Array
    image_row: Array
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
        """Return the rows that a mask or an index array selects."""
        return WandDetections(*(getattr(self, name)[rows] for name in self.__slots__))

    def rays(self) -> Array:
        """Return (n, 3) unit viewing rays, camera frames."""
        rays = np.column_stack([self.xy, np.ones(len(self))])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def gather(
    messages: Sequence[Detections], names: Sequence[str], lenses: Sequence[Camera]
) -> tuple[FrameTable, WandDetections]:
    """Collect the detections of the cameras `names` from their messages.

    The `id` of a roundel becomes its label. Detections outside the valid area of a lens model are dropped.
    """
    index = {name: k for k, name in enumerate(names)}
    messages = sorted(messages, key=lambda message: (index[message.camera], message.t_ns))
    camera_of, t_ns, bound_us, stated_us, *columns = zip(
        *map(attrgetter(*HEADER, *COLUMNS), messages), strict=True
    )
    camera = np.array([index[name] for name in camera_of], np.intp)
    readout_s = np.array([lenses[k].readout_s(us) for k, us in zip(camera, stated_us, strict=True)])
    frames = FrameTable(camera, (np.array(t_ns) - min(t_ns)) * 1e-9, readout_s)
    tables = [_read_column(data, *shape) for data, shape in zip(columns, COLUMNS.values(), strict=True)]
    uv, cov, axes_px, angle_rad, number = tables
    frame = np.repeat(np.arange(len(messages)), [len(data) // 16 for data in columns[0]])
    image_row = image_rows(lenses, camera[frame], uv)
    detections = WandDetections(
        camera[frame],
        frame,
        frames.t_s[frame] + readout_s[frame] * image_row,
        image_row,
        stamp_sigmas(camera, 1e-6 * np.array(bound_us))[frame],
        number[:, 0].astype(np.intp),
        uv,
        cov[:, [0, 1, 1, 2]].reshape(-1, 2, 2),
        axes_px,
        angle_rad[:, 0],
        normalise(lenses, camera[frame], uv),
    )
    return frames, detections.select(np.flatnonzero(np.isfinite(detections.xy).all(axis=1)))


def image_rows(lenses: Sequence[Lens], camera: Index, uv: Array) -> Array:
    """Return (n,) heights in the image of pixels (n, 2) of the cameras (n,), see `Lens.image_row`."""
    rows = np.empty(len(uv))
    for k, lens in enumerate(lenses):
        rows[camera == k] = lens.image_row(uv[camera == k])
    return rows


def normalise(lenses: Sequence[Lens], camera: Index, uv: Array) -> Array:
    """Return (n, 2) undistorted image plane coordinates of pixels (n, 2) of the cameras (n,); NaN where invalid."""
    xy = np.full(uv.shape, np.nan)
    for k, lens in enumerate(lenses):
        xy[camera == k] = lens.normalise(uv[camera == k])
    return xy


def stamp_sigmas(camera: Index, bound_s: Array) -> Array:
    """Return (F,) standard deviations of frame timestamps, seconds, without the estimated offset of each camera.

    An error within the smallest bound of a camera can be common to all its frames: the time offset absorbs it. A frame
    with a larger bound has a further error, uniform within the difference of the bounds. A frame from before the first
    reply of the server has no bound: its timestamp comes from an unsynchronized clock.

    Args:
        camera: (F,) index of the camera.
        bound_s: (F,) bound of the clock error, NaN if unknown.
    """
    bound_s = np.nan_to_num(bound_s, nan=MAX_CLOCK_ERROR_S)
    least = np.full(camera.max() + 1, np.inf)
    np.minimum.at(least, camera, bound_s)
    return (bound_s - least[camera]) / np.sqrt(3)


def _read_column(data: Sequence[bytes], dtype: str, width: int) -> Array:
    return np.frombuffer(b"".join(data), dtype).reshape(-1, width).astype(float)


def ranges(lenses: Sequence[Lens], detections: Ellipses, diameter_m: float) -> Array:
    """Return (n,) distances of discs from the cameras, metres, from the angle that their major axis subtends.

    A disc of diameter d at distance r and any slant subtends the angle 2 atan(d / 2r) along its major axis. NaN where
    a detection has no axes.
    """
    along = np.column_stack([np.cos(detections.angle_rad), np.sin(detections.angle_rad)])
    half = detections.axes_px[:, :1] / 2 * along
    distances = np.full(len(detections.uv), np.nan)
    for k, lens in enumerate(lenses):
        rows = np.flatnonzero((detections.camera == k) & np.isfinite(half).all(axis=1))
        if len(rows):
            a, b = (lens.rays(detections.uv[rows] + sign * half[rows]) for sign in (-1, 1))
            apart = np.maximum(np.linalg.norm(a - b, axis=1), 1e-12)
            distances[rows] = diameter_m / apart * np.linalg.norm(a + b, axis=1) / 2
    return distances


def count_frames(detections: WandDetections, cameras: int) -> list[int]:
    """Count the frames with detections, by camera."""
    first = np.flatnonzero(np.diff(detections.frame, prepend=-1))
    return np.bincount(detections.camera[first], minlength=cameras).tolist()
