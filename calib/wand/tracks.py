# SPDX-License-Identifier: BSD-3-Clause
"""Image tracks of the wand's markers: their interpolation in time, and triangulation from several cameras."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.wand.detections import WandDetections
from calib.wand.trajectory import hermite
from camera_node.foundation.arrays import Array, Index, Mask

ROUNDS = 8  # of reweighting in a triangulation
CAUCHY = 0.003  # scale of the weights: angle between a ray and the point, radians
AGREE = 4.0  # times the median of these angles: a ray within agrees with the point
SAME_S = 1e-6  # stamps closer than this are equal: they are whole nanoseconds, here as seconds
MIN_ANGLE = 1e-4  # ratio of the information along the worst and the best axis, below which rays are parallel


@dataclass(frozen=True, slots=True)
class MarkerTrack:
    """One marker in one camera: timestamps (n,) ascending, positions (n, 2) and their velocities (n, 2)."""

    t_s: Array
    xy: Array
    velocity: Array

    @classmethod
    def of(cls, t_s: Array, xy: Array) -> "MarkerTrack":
        """Compute velocities by central differences."""
        if len(t_s) < 2:
            return cls(t_s, xy, np.zeros_like(xy))
        step = np.diff(xy, axis=0) / np.diff(t_s)[:, None]
        velocity = np.concatenate([step[:1], (step[1:] + step[:-1]) / 2, step[-1:]])
        return cls(t_s, xy, velocity)

    def interpolate(self, t_s: Array, gap_s: float) -> Array:
        """Return positions (..., 2) at timestamps (...), by cubic Hermite polynomials; NaN in gaps above `gap_s`,
        except at the track's own timestamps."""
        if not len(self.t_s):
            return np.full((*t_s.shape, 2), np.nan)
        if len(self.t_s) == 1:
            return np.where(np.abs(t_s - self.t_s[0])[..., None] < SAME_S, self.xy[0], np.nan)
        after = np.clip(np.searchsorted(self.t_s, t_s), 1, len(self.t_s) - 1)
        tau, dt = t_s - self.t_s[after - 1], self.t_s[after] - self.t_s[after - 1]
        inside = (tau >= -SAME_S) & (tau <= dt + SAME_S) & (dt <= gap_s)
        inside |= np.minimum(np.abs(tau), np.abs(dt - tau)) < SAME_S
        h = hermite(tau.ravel(), dt.ravel()).reshape(*t_s.shape, 4)
        p, v = self.xy, self.velocity
        found = h[..., :1] * p[after - 1] + h[..., 1:2] * v[after - 1]
        found += h[..., 2:3] * p[after] + h[..., 3:] * v[after]
        return np.where(inside[..., None], found, np.nan)


def build_tracks(detections: WandDetections, cameras: int, markers: int) -> list[list[MarkerTrack]]:
    """Return tracks by camera and marker, in undistorted image plane coordinates, by timestamps."""
    tracks = []
    for camera in range(cameras):
        mine = detections.camera == camera
        rows = [np.flatnonzero(mine & (detections.label == marker)) for marker in range(markers)]
        tracks.append([MarkerTrack.of(detections.t_s[k], detections.xy[k]) for k in rows])
    return tracks


def interpolate(tracks: Sequence[MarkerTrack], label: Index, t_s: Array, gap_s: float) -> Array:
    """Return positions (..., n, 2) of the markers `label` (n,) at timestamps (..., n); `tracks` are by marker."""
    found = np.full((*t_s.shape, 2), np.nan)
    for marker, track in enumerate(tracks):
        mine = label == marker
        found[..., mine, :] = track.interpolate(t_s[..., mine], gap_s)
    return found


def triangulate(
    tracks: Sequence[Sequence[MarkerTrack]], poses: Array, offset_s: Array, t_s: Array, gap_s: float
) -> tuple[Array, Index]:
    """Locate the markers at given times, robustly.

    Minimises the distances to all viewing rays, reweighted by a Cauchy kernel.

    Args:
        tracks: by camera and marker, by timestamps.
        poses: (C, 4, 4) T_world_cam.
        offset_s: (C,) true time = timestamp + offset.
        t_s: (K,) true times.
        gap_s: the longest gap over which tracks are interpolated.

    Returns:
        points: (K, M, 3) markers, world; NaN if fewer than two cameras saw the marker near that time, or their rays
            are nearly parallel.
        agreeing: (K, M) number of rays that agree with the point.
    """
    xy = np.array(
        [
            [track.interpolate(t_s - offset, gap_s) for track in markers]
            for markers, offset in zip(tracks, offset_s, strict=True)
        ]
    )  # (C, M, K, 2)
    known = np.isfinite(xy[..., 0])
    ray = np.concatenate([np.nan_to_num(xy), np.ones((*xy.shape[:3], 1))], axis=3)
    ray = np.einsum("cij,cmkj->cmki", poses[:, :3, :3], ray / np.linalg.norm(ray, axis=3, keepdims=True))
    points, angle = intersect(ray, poses[:, :3, 3], known)
    usual = float(np.median(angle[known])) if known.any() else 0.0
    agreeing = (known & (angle <= AGREE * usual)).sum(axis=0)
    return np.swapaxes(points, 0, 1), agreeing.T


def intersect(ray: Array, centre: Array, known: Mask, rounds: int = ROUNDS) -> tuple[Array, Array]:
    """Return points (M, K, 3) nearest to `known` (C, M, K) rays (C, M, K, 3) through centres (C, 3), and the rays'
    angles (C, M, K) to them; points are NaN where fewer than two rays are known, or they are nearly parallel.
    The first of the rounds weighs all rays alike."""
    across = np.eye(3) - ray[..., :, None] * ray[..., None, :]
    toward = np.einsum("cmkij,cj->cmki", across, centre)
    weight = known.astype(float)
    points, angle = np.full((*known.shape[1:], 3), np.nan), np.zeros(known.shape)
    for _ in range(rounds):
        A, b = np.einsum("cmk,cmkij->mkij", weight, across), np.einsum("cmk,cmki->mki", weight, toward)
        spread = np.linalg.eigvalsh(A)
        solvable = (known.sum(axis=0) >= 2) & (spread[..., 0] > MIN_ANGLE * spread[..., 2])
        points[:] = np.nan
        points[solvable] = np.linalg.solve(A[solvable], b[solvable][:, :, None])[:, :, 0]
        away = np.nan_to_num(points) - centre[:, None, None]
        angle = np.linalg.norm(np.einsum("cmkij,cmkj->cmki", across, away), axis=3)
        angle /= np.maximum(np.linalg.norm(away, axis=3), 1e-9)
        weight = known / (angle**2 + CAUCHY**2) * CAUCHY**2
    return points, angle
