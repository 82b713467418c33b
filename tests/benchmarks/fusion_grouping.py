# SPDX-License-Identifier: BSD-3-Clause
"""Grouping without history: identical discs of one size in many views."""

import time
from collections import Counter

import numpy as np

from fusion.model.camera_array import CameraArray
from fusion.model.frames import FrameSet
from fusion.model.observations import DetectionTable
from fusion.tracking.multiview import find_markers
from tests.benchmarks.fusion_load import DIAMETER_M, Load

APART_M = 0.12  # between the centres of discs of 0.08 m with their white margins


def cold_grouping(seed: int, points: int = 130, cameras: int = 10, sigma_px: float = 0.3, sized: bool = True):
    """Precision and recall of the points that two or more cameras see, and processor seconds.

    A marker is correct if all its detections belong to one point; a point is found if a correct marker has it.
    """
    load = Load(
        points, 1, cameras, speed_m_s=0, missing=0, false=0, synchronised=True, sigma_px=sigma_px, seed=seed
    )
    load.paths.place(scattered(points, seed))
    frames = tuple(load.frames(1 / load.hz))
    seen = Counter(int(k) for frame in frames for k in frame.roundels.id)
    camera_array = CameraArray(load.rig)
    detections = DetectionTable.of(FrameSet(frames[0].t_ns, frames), camera_array, 0.0)
    if not sized:
        detections.axes_px[:] = np.nan
    rows, sizes = np.arange(len(detections)), np.array([DIAMETER_M])
    find_markers(camera_array, detections, rows, sizes)
    start = time.process_time()
    markers = find_markers(camera_array, detections, rows, sizes)
    cost_s = time.process_time() - start
    number = np.concatenate([frame.roundels.id for frame in frames])
    kinds = [set(number[marker.detections].tolist()) for marker in markers]
    right = [kind for kind in kinds if len(kind) == 1]
    many = {k for k, count in seen.items() if count >= 2}
    return len(right) / max(len(kinds), 1), len(set().union(*right) & many) / len(many), cost_s


def scattered(n: int, seed: int) -> np.ndarray:
    """(n, 3) points in the arena, no closer to each other than discs can be."""
    rng, places = np.random.default_rng(seed), np.empty((0, 3))
    while len(places) < n:
        p = rng.uniform([-2.3, -1.4, 0.05], [2.3, 1.4, 0.8])
        if not len(places) or np.linalg.norm(places - p, axis=1).min() > APART_M:
            places = np.vstack([places, p])
    return places
