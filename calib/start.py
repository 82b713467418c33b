# SPDX-License-Identifier: BSD-3-Clause
"""A first rig: the pairs' geometry along the best spanning tree, whichever camera comes first."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib.pairwise import MIN_INSTANTS, TwoView
from calib.views import View
from camera_node.pose import invert

Array = NDArray[np.float64]


def spanning_tree(pairs: Sequence[TwoView]) -> list[TwoView]:
    """The maximum spanning tree by inliers (Kruskal) of the largest group of connected cameras, best pair first."""
    group: dict[str, frozenset[str]] = {}
    chosen = []
    for pair in sorted(pairs, key=lambda pair: (-pair.inliers, pair.a, pair.b)):
        left, right = group.get(pair.a, frozenset([pair.a])), group.get(pair.b, frozenset([pair.b]))
        if left != right:
            chosen.append(pair)
            group |= dict.fromkeys(left | right, left | right)
    if not chosen:
        return []
    largest = max(group.values(), key=lambda g: (len(g), sum(p.inliers for p in chosen if p.a in g), min(g)))
    return [pair for pair in chosen if pair.a in largest]


def place_cameras(tree: Sequence[TwoView]) -> dict[str, Array]:
    """T_first_camera (4, 4) of every camera of the tree, in the frame of its first pair's first camera.

    A pair whose scale is unknown takes the scale of the pairs before it, by the distances of what they have in common.
    """
    if not tree:
        return {}
    placed = {tree[0].a: np.eye(4)}
    depths: dict[tuple[str, int, int], float] = {}
    waiting = list(tree)
    while waiting:
        pair = next(p for p in waiting if (p.a in placed) != (p.b in placed))
        waiting.remove(pair)
        scale = 1.0 if pair.metric else _common_scale(pair, depths)
        T_a_b = pair.T_a_b.copy()
        T_a_b[:3, 3] *= scale
        if pair.a in placed:
            placed[pair.b] = placed[pair.a] @ T_a_b
        else:
            placed[pair.a] = placed[pair.b] @ invert(T_a_b)
        depths |= {key: scale * depth for key, depth in pair.depths.items()}
    return placed


def _common_scale(pair: TwoView, depths: dict[tuple[str, int, int], float]) -> float:
    ratios = [depths[key] / depth for key, depth in pair.depths.items() if key in depths]
    return float(np.median(ratios)) if ratios else 1.0


def explain_unplaced(
    cameras: Sequence[str], placed: Sequence[str], views: dict[str, int], shared: dict[tuple[str, str], int]
) -> dict[str, str]:
    """Why each camera that is not placed is not."""
    reasons = {}
    for name in cameras:
        if name in placed:
            continue
        if not views.get(name):
            reasons[name] = "never saw the wand"
            continue
        counts = {b if a == name else a: n for (a, b), n in shared.items() if name in (a, b)}
        told = ", ".join(f"{n} with {other}" for other, n in sorted(counts.items()))
        reasons[name] = (
            f"instants shared with other cameras: {told}; {MIN_INSTANTS} or more that agree are needed"
        )
    return reasons


def triangulate(
    instants: Sequence[Sequence[View]], T_world_cam: dict[str, Array], markers: int, iterations: int = 10
) -> Array:
    """Markers (K, M, 3) at the instants: nearest to all viewing rays, rays that miss by more counting less.

    NaN where fewer than two of the placed cameras saw the marker, or their rays are nearly parallel.
    """
    slot, origin, ray = [], [], []
    for k, instant in enumerate(instants):
        for view in instant:
            if (T := T_world_cam.get(view.camera)) is None:
                continue
            rays = np.column_stack([view.xy, np.ones(len(view.xy))]) @ T[:3, :3].T
            slot += (k * markers + view.labels).tolist()
            origin += [T[:3, 3]] * len(rays)
            ray += (rays / np.linalg.norm(rays, axis=1, keepdims=True)).tolist()
    where, c, d = np.array(slot, np.intp), np.array(origin).reshape(-1, 3), np.array(ray).reshape(-1, 3)
    count = len(instants) * markers
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    weight = np.ones(len(d))
    points = np.full((count, 3), np.nan)
    for _ in range(iterations):
        A, b = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(A, where, weight[:, None, None] * across)
        np.add.at(b, where, weight[:, None] * np.einsum("nij,nj->ni", across, c))
        spread = np.linalg.eigvalsh(A)
        solvable = spread[:, 0] > 1e-4 * spread[:, 2]
        points[:] = np.nan
        points[solvable] = np.linalg.solve(A[solvable], b[solvable][:, :, None])[:, :, 0]
        away = points[where] - c
        miss = np.linalg.norm(np.einsum("nij,nj->ni", across, away), axis=1) / np.linalg.norm(away, axis=1)
        weight = np.nan_to_num(1 / (miss**2 + 0.003**2))
        weight /= weight.max(initial=1e-12)
    return points.reshape(len(instants), markers, 3)
