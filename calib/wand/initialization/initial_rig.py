# SPDX-License-Identifier: BSD-3-Clause
"""A first rig: the pairs' geometry and clocks along the best spanning tree, whichever camera comes first."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.wand.initialization.two_view import MIN_INSTANTS, MIN_SHARE, TwoView, TwoViewGeometry
from calib.wand.tracks import MarkerTrack
from camera_node.arrays import Array, Index
from camera_node.geometry.pose import invert


@dataclass(frozen=True, slots=True)
class InitialRig:
    """Cameras by number, roughly: `poses` (4, 4) p_any = T p_camera, and `offset_s`, true time = stamp + offset.

    `metric` is False where nothing gave the scale; `refused` holds the pairs of cameras that share enough and whose
    geometry too few of their sightings agree to, with that share.
    """

    poses: dict[int, Array]
    offset_s: dict[int, float]
    metric: bool
    refused: dict[tuple[int, int], float]


def find_start(pairs: TwoViewGeometry, cameras: Sequence[int]) -> InitialRig:
    """Place as many of `cameras` as are connected."""
    refused: dict[tuple[int, int], float] = {}
    tree = spanning_tree(pairs, cameras, refused)
    poses, offsets = _unfold(tree)
    return InitialRig(poses, offsets, bool(tree) and tree[0].metric, refused)


def spanning_tree(
    pairs: TwoViewGeometry, cameras: Sequence[int], refused: dict[tuple[int, int], float]
) -> list[TwoView]:
    """The maximum spanning tree by shared moments (Kruskal) of the largest group of connected cameras.

    A pair is looked at only where it would join two groups; one that most of its sightings contradict joins none.
    """
    shared, group, chosen = pairs.shared(), {c: frozenset([c]) for c in cameras}, []
    ends = [(a, b) for a in cameras for b in cameras if a < b and shared[a, b] >= MIN_INSTANTS // 2]
    for a, b in sorted(ends, key=lambda ab: (-shared[ab], ab)):
        if group[a] == group[b]:
            continue
        pair = pairs.relate(a, b)
        if pair is None or pair.share < MIN_SHARE:
            refused[a, b] = pair.share if pair else 0.0
            continue
        chosen.append(pair)
        group |= dict.fromkeys(group[a] | group[b], group[a] | group[b])
    if not chosen:
        return []
    largest = max(group.values(), key=lambda g: (len(g), sum(p.inliers for p in chosen if p.a in g), -min(g)))
    return [pair for pair in chosen if pair.a in largest]


def _unfold(tree: Sequence[TwoView]) -> tuple[dict[int, Array], dict[int, float]]:
    """Poses in the frame of the first pair's first camera; offsets whose median is 0.

    A pair whose scale is unknown takes the scale of the pairs before it, by the distances of what they have in common.
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
    middle = float(np.median(list(offsets.values())))
    return poses, {camera: offset - middle for camera, offset in offsets.items()}


def _common_scale(pair: TwoView, depth: dict[int, float]) -> float:
    ratios = [depth[row] / far for row, far in pair.depth.items() if row in depth]
    return float(np.median(ratios)) if ratios else 1.0


def explain_unplaced(
    names: Sequence[str],
    placed: Sequence[int],
    frames: Sequence[int],
    shared: Index,
    start: InitialRig,
) -> dict[str, str]:
    """Why each camera that is not placed is not."""
    reasons = {}
    for k in (k for k in range(len(names)) if k not in placed):
        refused = {(set(pair) - {k}).pop(): share for pair, share in start.refused.items() if k in pair}
        told = ", ".join(f"{shared[k, j]} with {name}" for j, name in enumerate(names) if j != k)
        if not frames[k]:
            reasons[names[k]] = "never saw the wand; wave before it"
        elif refused and (share := max(refused.values())) > 0:
            reasons[names[k]] = (
                f"what it saw fits no other camera (at best {share:.0%} of the sightings it shares); "
                "is it named right, is its clock right, and are its intrinsics its own?"
            )
        else:
            reasons[names[k]] = (
                f"instants shared with other cameras: {told}; {MIN_INSTANTS} or more that agree are needed; "
                "wave where its view overlaps theirs"
            )
    return reasons


def triangulate(
    tracks: Sequence[Sequence[MarkerTrack]],
    poses: Array,
    offset_s: Array,
    t_s: Array,
    gap_s: float,
    rounds: int = 8,
) -> tuple[Array, Index]:
    """Markers (K, M, 3) at times (K,): nearest to all viewing rays, rays that miss by more counting less.

    NaN where fewer than two cameras saw the marker about then, or their rays are nearly parallel. Also the number of
    rays (K, M) that agree to each, as well as rays usually do.

    Args:
        tracks: by camera and marker, by stamps.
        poses, offset_s: (C, 4, 4) and (C,) of these cameras.
        gap_s: the longest time over which tracks are interpolated.
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
    across = np.eye(3) - ray[..., :, None] * ray[..., None, :]
    toward = np.einsum("cmkij,cj->cmki", across, poses[:, :3, 3])
    weight = known.astype(float)
    points, miss = np.full((*known.shape[1:], 3), np.nan), np.zeros(known.shape)
    for _ in range(rounds):
        A, b = np.einsum("cmk,cmkij->mkij", weight, across), np.einsum("cmk,cmki->mki", weight, toward)
        spread = np.linalg.eigvalsh(A)
        solvable = (known.sum(axis=0) >= 2) & (spread[..., 0] > 1e-4 * spread[..., 2])
        points[:] = np.nan
        points[solvable] = np.linalg.solve(A[solvable], b[solvable][:, :, None])[:, :, 0]
        away = np.nan_to_num(points) - poses[:, None, None, :3, 3]
        miss = np.linalg.norm(np.einsum("cmkij,cmkj->cmki", across, away), axis=3)
        miss /= np.maximum(np.linalg.norm(away, axis=3), 1e-9)
        weight = known / (miss**2 + 0.003**2) * 0.003**2
    usual = float(np.median(miss[known])) if known.any() else 0.0
    agreeing = (known & (miss <= 4 * usual)).sum(axis=0)
    return np.swapaxes(points, 0, 1), agreeing.T
