# SPDX-License-Identifier: BSD-3-Clause
"""Markers from frame to frame of one camera: labels carried over, and where a marker was between two frames."""

from dataclasses import dataclass

import numpy as np

from calib.wand.detections import FrameTable, WandDetections
from calib.wand.trajectory import hermite
from camera_node.arrays import Array, Index

FOLLOW_PX = 8.0  # how far a marker may be from between its neighbours, at least
FOLLOW_SHARE = 0.15  # and of the way from one to the next
FOLLOW_FRAMES = 3.5  # for how many frame periods labels are carried over


@dataclass(frozen=True, slots=True)
class MarkerTrack:
    """One marker in one camera: times (n,) ascending, and positions and velocities (n, 2)."""

    t_s: Array
    at: Array
    velocity: Array

    @classmethod
    def of(cls, t_s: Array, at: Array) -> "MarkerTrack":
        """Velocities by central differences."""
        if len(t_s) < 2:
            return cls(t_s, at, np.zeros_like(at))
        step = np.diff(at, axis=0) / np.diff(t_s)[:, None]
        velocity = np.concatenate([step[:1], (step[1:] + step[:-1]) / 2, step[-1:]])
        return cls(t_s, at, velocity)

    def interpolate(self, t_s: Array, gap_s: float) -> Array:
        """Positions at times of any shape (...), (..., 2), by cubic Hermite polynomials; NaN in gaps above `gap_s`."""
        if len(self.t_s) < 2:
            return np.full((*t_s.shape, 2), np.nan)
        after = np.clip(np.searchsorted(self.t_s, t_s), 1, len(self.t_s) - 1)
        tau, dt = t_s - self.t_s[after - 1], self.t_s[after] - self.t_s[after - 1]
        inside = (tau >= -1e-6) & (tau <= dt + 1e-6) & (dt <= gap_s)
        h = hermite(tau.ravel(), dt.ravel()).reshape(*t_s.shape, 4)
        p, v = self.at, self.velocity
        found = h[..., :1] * p[after - 1] + h[..., 1:2] * v[after - 1]
        found += h[..., 2:3] * p[after] + h[..., 3:] * v[after]
        return np.where(inside[..., None], found, np.nan)


def tracks_of(seen: WandDetections, cameras: int, markers: int) -> list[list[MarkerTrack]]:
    """Tracks by camera and marker, in undistorted image plane coordinates, by stamps."""
    found = []
    for camera in range(cameras):
        mine = [np.flatnonzero((seen.camera == camera) & (seen.label == marker)) for marker in range(markers)]
        found.append([MarkerTrack.of(seen.t_s[rows], seen.xy[rows]) for rows in mine])
    return found


def follow(frames: FrameTable, seen: WandDetections, labels: Index, markers: int) -> Index:
    """Labels also for detections that lie where a marker must have been between two labelled frames of its camera.

    Each marker is sought linearly between its neighbours; the detection nearest to it takes its label if it is no
    nearer to another marker.
    """
    labels = labels.copy()
    gap_s = FOLLOW_FRAMES * frames.period_s()
    for camera in np.unique(frames.camera):
        open_rows = np.flatnonzero((seen.camera == camera) & (labels < 0))
        away = np.full((len(open_rows), markers), np.inf)
        for marker in range(markers):
            known = np.flatnonzero((seen.camera == camera) & (labels == marker))
            if len(known) < 2:
                continue
            after = np.searchsorted(seen.t_s[known], seen.t_s[open_rows])
            inside = (after > 0) & (after < len(known))
            inside &= ~np.isin(seen.frame[open_rows], seen.frame[known])
            a, b = known[np.clip(after - 1, 0, None)], known[np.clip(after, None, len(known) - 1)]
            dt = np.maximum(seen.t_s[b] - seen.t_s[a], 1e-9)
            share = ((seen.t_s[open_rows] - seen.t_s[a]) / dt)[:, None]
            off = np.linalg.norm(seen.uv[open_rows] - (1 - share) * seen.uv[a] - share * seen.uv[b], axis=1)
            gate = FOLLOW_PX + FOLLOW_SHARE * np.linalg.norm(seen.uv[b] - seen.uv[a], axis=1)
            away[:, marker] = np.where(inside & (dt <= gap_s) & (off < gate), off, np.inf)
        _assign(seen.frame[open_rows], away, labels, open_rows)
    return labels


def _assign(frame: Index, away: Array, labels: Index, rows: Index) -> None:
    """Give each row its nearest marker, and each marker its nearest row of a frame."""
    nearest = away.argmin(axis=1)
    far = away[np.arange(len(away)), nearest] if len(away) else np.empty(0)
    order = np.lexsort((far, nearest, frame))
    key = frame[order] * (away.shape[1] + 1) + nearest[order]
    first = np.diff(key, prepend=-1) != 0
    chosen = order[first & np.isfinite(far[order])]
    labels[rows[chosen]] = nearest[chosen]
