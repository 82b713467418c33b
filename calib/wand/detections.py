# SPDX-License-Identifier: BSD-3-Clause
"""The detections of a recording as columns, how its frames are related in time, and the image tracks of markers.

One row per detection, frames and cameras by index.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibrationError
from calib.rig.camera import Camera
from calib.wand.trajectory import finite_velocities, hermite
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.foundation.columns import Columns
from camera_node.geometry.body import Body
from camera_node.geometry.codes import PLAIN
from camera_node.geometry.lens import Lens
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
UNREAD = np.array(np.nan, "<f4").tobytes()  # in the column `id_probability`: no code was read
FOREIGN = -2  # label of a roundel with the code of another object
MAX_GAP_PERIODS, MAX_GAP_S = 2.5, 0.5  # longest interpolation of a track: frame periods, and seconds
MAX_SPREAD_S = 0.1  # a hand moves decimetres in this time
# Frames this close form one set at any frame rate: the motion between them is interpolated
MIN_SPREAD_S = 0.02
# Share of each camera's frames that share a stamp with another camera, from which cameras may be synchronous. Stamps of
# free-running cameras, rounded to milliseconds, coincide by chance for 40 % of the frames of eight cameras at 60 Hz.
MIN_COINCIDENT = 0.8
SAME_S = 1e-6  # stamps closer than this are equal: they are whole nanoseconds, here as seconds


@dataclass(frozen=True, slots=True, eq=False)
class FrameTable(Columns):
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


@dataclass(frozen=True, slots=True, eq=False)
class MarkerImages(Columns):
    """Images of the wand's markers.

    Attributes:
        camera: (n,) index of the camera.
        label: (n,) marker of the wand, -1 if unknown.
        t_s: (n,) timestamp of the frame, seconds; of the detection's row where the readout time is given.
        image_row: (n,) height in the image, -1/2 to 1/2 (`Lens.image_row`).
        stamp_sigma_s: (n,) standard deviation of the timestamp, without the offset common to the camera's timestamps.
        uv: (n, 2) centre of the ellipse, raw pixels.
        cov: (n, 2, 2) covariance of the centre, square pixels.
        axes_px, angle_rad: (n, 2) full axes and (n,) direction of the ellipse; NaN if unknown.
    """

    camera: Index
    label: Index
    t_s: Array
    image_row: Array
    stamp_sigma_s: Array
    uv: Array
    cov: Array
    axes_px: Array
    angle_rad: Array


@dataclass(frozen=True, slots=True, eq=False)
class WandDetections(MarkerImages):
    """Detections, sorted by frame.

    Attributes:
        frame: (n,) index of the frame.
        xy: (n, 2) undistorted image plane coordinates of `uv`.
    """

    frame: Index
    xy: Array

    def rays(self) -> Array:
        """Return (n, 3) unit viewing rays, camera frames."""
        rays = np.column_stack([self.xy, np.ones(len(self))])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def gather(
    messages: Sequence[Detections],
    names: Sequence[str],
    lenses: Sequence[Camera],
    codes: Sequence[int] = (),
) -> tuple[FrameTable, WandDetections]:
    """Collect the detections of the cameras `names` from their messages.

    A number that another program gave is the label. A code that a detector read labels the marker that has it among
    `codes` (`Body.codes`); a roundel with another code belongs to another object, and is dropped. So are detections
    outside the valid area of a lens model; those a little outside the image are not: a corner of a tag can be.
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
    probability = [message.id_probability or UNREAD * len(message) for message in messages]
    is_code = np.isfinite(_read_column(probability, "<f4", 1)[:, 0])
    label = np.where(is_code, FOREIGN, number[:, 0]).astype(np.intp)
    for k, code in enumerate(codes):
        if code != PLAIN:
            label[is_code & (number[:, 0] == code)] = k
    frame = np.repeat(np.arange(len(messages)), [len(data) // 16 for data in columns[0]])
    image_row = image_rows(lenses, camera[frame], uv)
    detections = WandDetections(
        camera[frame],
        label,
        frames.t_s[frame] + readout_s[frame] * image_row,
        image_row,
        stamp_sigmas(camera, 1e-6 * np.array(bound_us))[frame],
        uv,
        cov[:, [0, 1, 1, 2]].reshape(-1, 2, 2),
        axes_px,
        angle_rad[:, 0],
        frame,
        normalise(lenses, camera[frame], uv),
    )
    usable = np.isfinite(detections.xy).all(axis=1) & (detections.label != FOREIGN)
    return frames, detections.select(np.flatnonzero(usable))


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


def ranges(lenses: Sequence[Lens], detections: MarkerImages, diameter_m: float) -> Array:
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


@dataclass(frozen=True, slots=True)
class Timing:
    """The relation of frames in time.

    Attributes:
        period_s: median time between the frames of a camera; 0 if unknown.
        synchronous: frames with equal stamps are simultaneous; all others are unrelated, so neither clocks nor the
            motion of the wand matter. Otherwise stamps may be offset, and tracks are interpolated in time.
        aligned: the motion showed that the clocks differ, and stamps are corrected by what it shows.
    """

    period_s: float
    synchronous: bool = False
    aligned: bool = False

    @property
    def gap_s(self) -> float:
        """The longest time over which tracks and the wand's motion are interpolated; 0 for synchronous cameras."""
        if self.synchronous:
            return 0.0
        return min(MAX_GAP_PERIODS * self.period_s, MAX_GAP_S) if self.period_s else MAX_GAP_S

    @property
    def spread_s(self) -> float:
        """The longest time between the frames of one frame set: half a frame period, or 20 ms if that is longer."""
        if self.synchronous:
            return 0.0
        if not self.period_s:
            return MAX_SPREAD_S
        return min(max(self.period_s / 2, min(self.period_s, MIN_SPREAD_S)), MAX_SPREAD_S)

    def instants(self, t_s: Array) -> Index:
        """(n,) numbers of the instants at which stamps (n,) lie: of equal stamps, or of frame periods."""
        if self.synchronous or not self.period_s:
            return np.unique(t_s, return_inverse=True)[1]
        return np.floor((t_s - t_s.min(initial=np.inf)) / self.period_s).astype(np.intp)


def coincident_share(frames: FrameTable) -> float:
    """Return the share of frames whose stamp another camera's frame has too, of the camera with the smallest share."""
    _, instant, count = np.unique(frames.t_s, return_inverse=True, return_counts=True)
    shared = (count[instant] >= 2).astype(float)
    cameras = np.unique(frames.camera)
    return min(float(shared[frames.camera == camera].mean()) for camera in cameras)


@dataclass(frozen=True, slots=True)
class MarkerTrack:
    """One marker in one camera: timestamps (n,) ascending, positions (n, 2) and their velocities (n, 2)."""

    t_s: Array
    xy: Array
    velocity: Array

    @classmethod
    def of(cls, t_s: Array, xy: Array) -> "MarkerTrack":
        """Compute velocities by central differences."""
        return cls(t_s, xy, finite_velocities(t_s, xy[:, None], np.inf)[:, 0])

    def interpolate(self, t_s: Array, gap_s: float) -> Array:
        """Return positions (..., 2) at timestamps (...), by cubic Hermite polynomials; NaN in gaps above `gap_s`,
        except at the track's own timestamps."""
        if not len(self.t_s):
            return np.full((*t_s.shape, 2), np.nan)
        if len(self.t_s) == 1 or not gap_s:
            return self._at_own(t_s)
        after = np.clip(np.searchsorted(self.t_s, t_s), 1, len(self.t_s) - 1)
        tau, dt = t_s - self.t_s[after - 1], self.t_s[after] - self.t_s[after - 1]
        inside = (tau >= -SAME_S) & (tau <= dt + SAME_S) & (dt <= gap_s)
        inside |= np.minimum(np.abs(tau), np.abs(dt - tau)) < SAME_S
        h = hermite(tau.ravel(), dt.ravel()).reshape(*t_s.shape, 4)
        p, v = self.xy, self.velocity
        found = h[..., :1] * p[after - 1] + h[..., 1:2] * v[after - 1]
        found += h[..., 2:3] * p[after] + h[..., 3:] * v[after]
        return np.where(inside[..., None], found, np.nan)

    def _at_own(self, t_s: Array) -> Array:
        """Positions (..., 2) at timestamps (...) that are the track's own; NaN at others."""
        k = np.searchsorted(self.t_s, t_s - SAME_S)
        k = np.minimum(k, len(self.t_s) - 1)
        return np.where(np.abs(t_s - self.t_s[k])[..., None] < SAME_S, self.xy[k], np.nan)


def build_tracks(detections: WandDetections, cameras: int, markers: int) -> list[list[MarkerTrack]]:
    """Return tracks by camera and marker, in undistorted image plane coordinates, by timestamps."""
    rows = _rows_of_tracks(detections, cameras, markers)
    tracks = [MarkerTrack.of(detections.t_s[k], detections.xy[k]) for k in rows]
    return [tracks[camera * markers : (camera + 1) * markers] for camera in range(cameras)]


def _rows_of_tracks(detections: WandDetections, cameras: int, markers: int) -> list[Index]:
    """The detections of each track, by camera, then by marker."""
    return group_rows(detections.camera * markers + detections.label, cameras * markers)


def group_rows(number: Index, count: int) -> list[Index]:
    """The rows of each number below `count` among numbers (n,), ascending."""
    order = np.argsort(number, kind="stable")
    return np.split(order, np.searchsorted(number[order], np.arange(1, count)))


def interpolate(tracks: Sequence[MarkerTrack], label: Index, t_s: Array, gap_s: float) -> Array:
    """Return positions (..., n, 2) of the markers `label` (n,) at timestamps (..., n); `tracks` are by marker."""
    found = np.full((*t_s.shape, 2), np.nan)
    for track, mine in zip(tracks, group_rows(label, len(tracks)), strict=True):
        if len(mine):
            found[..., mine, :] = track.interpolate(t_s[..., mine], gap_s)
    return found


def gather_background(
    messages: Sequence[Detections], names: Sequence[str], lenses: Sequence[Camera], start_ns: int
) -> WandDetections | None:
    """Collect the images of background points as columns, with times in seconds after `start_ns`; the `id` of a
    detection is the number of its point. Cameras that are not among `names` are left out; None without any image.

    Raises:
        CalibrationError: detections have no numbers.
    """
    mine = [m for m in messages if m.camera in set(names) and len(m)]
    if not mine:
        return None
    first_ns = min(message.t_ns for message in mine)
    detections = gather(mine, names, lenses)[1]
    if (detections.label < 0).any():
        raise CalibrationError(
            "background points need numbers that are the same in all cameras: fill the column marker of their table"
        )
    return replace(detections, t_s=detections.t_s + (first_ns - start_ns) * 1e-9)


@dataclass(frozen=True, slots=True)
class WandRecording:
    """A labeled recording of C cameras, numbered 0 to C - 1.

    Attributes:
        names, lenses: of its cameras, sorted by name.
        wand: that was recorded.
        frames: all frames.
        timing: how the cameras' frames are related in time.
        detections: the markers of the wand, at most one row per frame and marker.
        tracks: of these by camera and marker, by stamps.
        left_out: by camera, the number of frames without a marker by reason.
        middle_s: stamp in the middle of the recording, at which time offsets are defined.
        readout_s: (C,) given readout times, which the times of detections contain.
        background: images of background points, if there are any.
    """

    names: list[str]
    lenses: list[Lens]
    wand: Body
    frames: FrameTable
    timing: Timing
    detections: WandDetections
    tracks: list[list[MarkerTrack]]
    left_out: list[Counter[str]]
    middle_s: float
    readout_s: Array
    background: WandDetections | None = None

    def of_cameras(self, chosen: Sequence[int]) -> "WandRecording":
        """The recording of some of the cameras, ascending, renumbered."""
        number = np.full(len(self.names), -1)
        number[chosen] = np.arange(len(chosen))
        mine = number[self.frames.camera] >= 0
        detections = _renumber(self.detections, number)
        names, lenses, tracks, left_out = (
            [column[k] for k in chosen] for column in (self.names, self.lenses, self.tracks, self.left_out)
        )
        return replace(
            self,
            names=names,
            lenses=lenses,
            frames=replace(self.frames, camera=number[self.frames.camera]).select(mine),
            detections=replace(detections, frame=(np.cumsum(mine) - 1)[detections.frame]),
            tracks=tracks,
            left_out=left_out,
            readout_s=self.readout_s[chosen],
            background=None if self.background is None else _renumber(self.background, number),
        )

    def with_detections(self, detections: WandDetections) -> "WandRecording":
        """The recording with other detections of the same cameras."""
        tracks = build_tracks(detections, len(self.lenses), len(self.wand.markers))
        return replace(self, detections=detections, tracks=tracks)

    def select(self, rows: NDArray) -> "WandRecording":
        """The recording with the detections that a mask or an index array selects."""
        return self.with_detections(self.detections.select(rows))

    def timed(self) -> Mask:
        """(n,) which detections the uncertainty of their stamps displaces by less than their noise, at the speed of the
        marker's image."""
        detections = self.detections
        rows = _rows_of_tracks(detections, len(self.lenses), len(self.wand.markers))
        focal_px = np.array([(lens.fx + lens.fy) / 2 for lens in self.lenses])
        speed = np.empty(len(detections))
        for mine, track in zip(rows, chain.from_iterable(self.tracks), strict=True):
            speed[mine] = np.linalg.norm(track.velocity, axis=1)
        off_px = detections.stamp_sigma_s * speed * focal_px[detections.camera]
        return np.asarray(off_px**2 <= np.einsum("nii->n", detections.cov), bool)

    def with_centres(self, rows: Index, uv: Array) -> "WandRecording":
        """The recording with other centres (n, 2), raw pixels, of the detections `rows` (n,)."""
        changed = self.detections.uv.copy()
        changed[rows] = uv
        xy = normalise(self.lenses, self.detections.camera, changed)
        return self.with_detections(replace(self.detections, uv=changed, xy=xy))

    def with_row_times(self, readout_s: Array) -> "WandRecording":
        """The recording with stamps of rows for readout times (C,) that are longer by this."""
        detections = self.detections
        later = readout_s[detections.camera] * detections.image_row
        return self.with_detections(replace(detections, t_s=detections.t_s + later))

    def undistort_tracks(self, lenses: Sequence[Lens]) -> "WandRecording":
        """The recording with its tracks undistorted by other lenses; `lenses` stay the given ones."""
        tracks = []
        for mine, old, new in zip(self.tracks, self.lenses, lenses, strict=True):
            xy = np.concatenate([track.xy for track in mine])
            xy = new.normalise(old.project(np.column_stack([xy, np.ones(len(xy))])))
            parts = np.split(xy, np.cumsum([len(track.xy) for track in mine])[:-1])
            tracks.append([MarkerTrack.of(track.t_s, part) for track, part in zip(mine, parts, strict=True)])
        return replace(self, tracks=tracks)


def _renumber(detections: WandDetections, number: Index) -> WandDetections:
    """The detections of the cameras whose `number` (C,) is not negative, under these."""
    camera = number[detections.camera]
    return replace(detections, camera=camera).select(camera >= 0)
