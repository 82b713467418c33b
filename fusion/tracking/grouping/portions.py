# SPDX-License-Identifier: BSD-3-Clause
"""Portions of crowded frames: the detections around one of them, another one in each turn."""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from camera_node.foundation.arrays import Index
from fusion.model.observations import CameraArray, DetectionTable
from fusion.tracking.grouping.rays import rays_of

MIN_LIMIT = 10  # detections of a frame in a portion: those of two robots


@dataclass(frozen=True, slots=True)
class Portion:
    """Of frames with more than `limit` detections, those nearest to one point; another one in each turn.

    The point is on the ray of a detection of such a frame, at the range of a marker of `diameter_m`.
    """

    limit: int
    turn: int
    diameter_m: float


def limit_of(n_frames: int, max_pairs: int) -> int:
    """Detections of each of `n_frames` frames, such that those of different frames make at most `max_pairs` pairs."""
    return max(MIN_LIMIT, int(sqrt(2 * max_pairs / max(1, n_frames * (n_frames - 1)))))


def portion_of(
    cameras: CameraArray, detections: DetectionTable, rows: Index, portion: Portion
) -> tuple[Index, Index]:
    """The rows of this portion, all rows of frames below the limit; and the cameras of the frames above it."""
    limit, diameter_m = portion.limit, portion.diameter_m
    rows = rows[np.isfinite(detections.xy[0, rows])]
    count = np.bincount(detections.frame[rows], minlength=len(detections.exposures.camera))
    above = np.flatnonzero(count > limit)
    crowded = np.unique(detections.exposures.camera[above])
    if not len(above):
        return rows, crowded
    rays = rays_of(cameras, detections, rows, np.array([diameter_m]))
    seeds = np.flatnonzero(np.isin(rays.frame, above) & np.isfinite(rays.size))
    if not len(seeds):
        return rows[~np.isin(rays.frame, above)], crowded
    seed = seeds[np.random.default_rng(portion.turn).integers(len(seeds))]
    to = rays.o[seed] + rays.d[seed] * diameter_m / rays.size[seed] - rays.o
    off = -np.einsum("ni,ni->n", rays.d, to / np.linalg.norm(to, axis=1, keepdims=True))
    rank = np.empty(len(rows), np.intp)
    order = np.lexsort((off, rays.frame))
    rank[order] = np.arange(len(rows)) - np.concatenate([[0], np.cumsum(count)])[rays.frame[order]]
    return rows[rank < limit], crowded
