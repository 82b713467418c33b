# SPDX-License-Identifier: BSD-3-Clause
"""Builds an initial rig: chains relative poses and clock shifts along the maximum spanning tree of camera pairs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.wand.initialization.two_view import MIN_FRAME_SETS, MIN_INLIER_RATIO, TwoView, TwoViewGeometry
from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import invert


@dataclass(frozen=True, slots=True)
class InitialRig:
    """Approximate poses and time offsets of the connected cameras.

    Attributes:
        poses: (4, 4) T_world_cam by camera index, in an arbitrary world.
        offset_s: by camera index, true time = timestamp + offset; median 0.
        metric: whether the scale is known.
        rejected: inlier ratio by pair of cameras, of the pairs that share enough frame sets but whose relative pose was
            rejected; 0 where there is none.
    """

    poses: dict[int, Array]
    offset_s: dict[int, float]
    metric: bool
    rejected: dict[tuple[int, int], float]

    @property
    def placed(self) -> list[int]:
        """Indices of the cameras with poses, ascending."""
        return sorted(self.poses)


def build_initial_rig(pairs: TwoViewGeometry, cameras: Sequence[int]) -> InitialRig:
    """Place the largest connected group of `cameras`."""
    tree, rejected = _build_spanning_tree(pairs, cameras)
    poses, offsets = _chain(tree)
    return InitialRig(poses, offsets, bool(tree) and tree[0].metric, rejected)


def _build_spanning_tree(
    pairs: TwoViewGeometry, cameras: Sequence[int]
) -> tuple[list[TwoView], dict[tuple[int, int], float]]:
    """Return the maximum spanning tree (Kruskal) of the largest group of connected cameras, and the rejected pairs.

    The weight of a pair is the number of shared frame sets. A pair is estimated only if it would join two groups.
    """
    shared, group, chosen = pairs.count_shared(), {c: frozenset([c]) for c in cameras}, []
    rejected: dict[tuple[int, int], float] = {}
    ends = [(a, b) for a in cameras for b in cameras if a < b and shared[a, b] >= MIN_FRAME_SETS // 2]
    for a, b in sorted(ends, key=lambda ab: (-shared[ab], ab)):
        if group[a] == group[b]:
            continue
        pair = pairs.relate(a, b)
        if pair is None or pair.inlier_ratio < MIN_INLIER_RATIO:
            rejected[a, b] = pair.inlier_ratio if pair else 0.0
            continue
        chosen.append(pair)
        group |= dict.fromkeys(group[a] | group[b], group[a] | group[b])
    if not chosen:
        return [], rejected
    largest = max(group.values(), key=lambda g: (len(g), sum(p.inliers for p in chosen if p.a in g), -min(g)))
    return [pair for pair in chosen if pair.a in largest], rejected


def _chain(tree: Sequence[TwoView]) -> tuple[dict[int, Array], dict[int, float]]:
    """Return poses in the frame of the first pair's camera a, and offsets with median 0.

    A pair of unknown scale takes the scale of the pairs before it, from the depths of their common detections.
    """
    if not tree:
        return {}, {}
    poses, offsets = {tree[0].a: np.eye(4)}, {tree[0].a: 0.0}
    depth: dict[int, float] = {}
    waiting = list(tree)
    while waiting:
        pair = next(p for p in waiting if (p.a in poses) != (p.b in poses))
        waiting.remove(pair)
        scale = 1.0 if pair.metric else _common_scale(pair, depth)
        T_a_b = pair.T_a_b.copy()
        T_a_b[:3, 3] *= scale
        if pair.a in poses:
            poses[pair.b], offsets[pair.b] = poses[pair.a] @ T_a_b, offsets[pair.a] - pair.shift_s
        else:
            poses[pair.a], offsets[pair.a] = poses[pair.b] @ invert(T_a_b), offsets[pair.b] + pair.shift_s
        depth |= {row: scale * far for row, far in pair.depth.items()}
    median = float(np.median(list(offsets.values())))
    return poses, {camera: offset - median for camera, offset in offsets.items()}


def _common_scale(pair: TwoView, depth: dict[int, float]) -> float:
    ratios = [depth[row] / far for row, far in pair.depth.items() if row in depth]
    return float(np.median(ratios)) if ratios else 1.0
