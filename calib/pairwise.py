# SPDX-License-Identifier: BSD-3-Clause
"""Two-view geometry: where two cameras stand to each other, from the instants at which both saw the wand.

Where each view alone places the markers (three on a line, or roundels of known size), the two sets of points are
brought together by RANSAC over Kabsch's motion. Else the essential matrix (Nister 2004) gives the motion up to scale,
and the wand's lengths the scale.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.alignment import rigid_motions
from calib.camera import transform
from calib.views import View
from camera_node.body import Body
from camera_node.lens import Lens
from camera_node.pose import invert

Array = NDArray[np.float64]

MIN_INSTANTS = 8  # that two cameras must share
TRIALS = 300
RELATIVE_GATE = 0.04  # of a one-view position, by the distance: sizes give it to one or two percent
GATE_PX = 3.0


@dataclass(frozen=True, slots=True)
class TwoView:
    """Camera b seen from camera a.

    Attributes:
        a, b: names.
        T_a_b: (4, 4) p_a = T_a_b p_b, metres if `metric`, else its translation has length 1.
        inliers: instants that agree with it.
        depths: distance to a marker by (camera, instant, label), in the unit of T_a_b: ties scales together.
    """

    a: str
    b: str
    T_a_b: Array
    inliers: int
    metric: bool
    depths: dict[tuple[str, int, int], float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Shared:
    """Markers that two cameras saw at the same instants: (n,) instants and labels, (n, 2) image plane coordinates,
    and (n, 3) one-view positions (NaN where unknown) in either camera."""

    instant: NDArray[np.intp]
    label: NDArray[np.intp]
    xy_a: Array
    xy_b: Array
    points_a: Array
    points_b: Array


def shared_markers(instants: Sequence[Sequence[View]], a: str, b: str) -> Shared:
    """What cameras a and b saw at the same instants."""
    rows: list[tuple] = []
    for k, instant in enumerate(instants):
        seen = {view.camera: view for view in instant}
        if a in seen and b in seen:
            labels = np.intersect1d(seen[a].labels, seen[b].labels)
            ra, rb = seen[a].rows_of(labels), seen[b].rows_of(labels)
            for label, i, j in zip(labels, ra, rb, strict=True):
                rows.append(
                    (k, label, *seen[a].xy[i], *seen[b].xy[j], *_point(seen[a], i), *_point(seen[b], j))
                )
    table = np.array(rows, float).reshape(-1, 12)
    index = table[:, :2].astype(np.intp)
    return Shared(index[:, 0], index[:, 1], table[:, 2:4], table[:, 4:6], table[:, 6:9], table[:, 9:12])


def _point(view: View, row: int) -> Array:
    return np.full(3, np.nan) if view.points is None else view.points[row]


def relate_all(
    instants: Sequence[Sequence[View]], lenses: Mapping[str, Lens], wand: Body
) -> tuple[list[TwoView], dict[tuple[str, str], int]]:
    """The geometry of every pair of cameras that has one, and the number of instants that each pair shares."""
    found, counts = [], {}
    for a, b in combinations(sorted(lenses), 2):
        shared = shared_markers(instants, a, b)
        counts[a, b] = len(np.unique(shared.instant))
        if counts[a, b] >= MIN_INSTANTS:
            pair = relate_by_points(shared, a, b) or relate_by_rays(shared, a, b, lenses[a], wand)
            if pair is not None and pair.inliers >= MIN_INSTANTS:
                found.append(pair)
    return found, counts


def relate_by_points(shared: Shared, a: str, b: str) -> TwoView | None:
    """The motion that brings the one-view positions in b to those in a, by RANSAC; None where too few have both."""
    known = np.isfinite(shared.points_a).all(axis=1) & np.isfinite(shared.points_b).all(axis=1)
    P, Q, instant = shared.points_a[known], shared.points_b[known], shared.instant[known]
    if len(np.unique(instant)) < MIN_INSTANTS:
        return None
    rng = np.random.default_rng(0)
    gate = RELATIVE_GATE * (np.linalg.norm(P, axis=1) + np.linalg.norm(Q, axis=1)) / 2
    samples = rng.integers(len(P), size=(TRIALS, 4))
    motions = rigid_motions(Q[samples], P[samples])
    moved = np.einsum("sij,nj->sni", motions[:, :3, :3], Q) + motions[:, None, :3, 3]
    inlier = np.linalg.norm(moved - P, axis=2) < gate
    best = inlier[inlier.sum(axis=1).argmax()]
    T = np.eye(4)
    for _ in range(3):
        if best.sum() < 4:
            return None
        T = rigid_motions(Q[best], P[best])
        best = np.linalg.norm(transform(T, Q) - P, axis=1) < gate
    return TwoView(a, b, T, len(np.unique(instant[best])), metric=True)


def relate_by_rays(shared: Shared, a: str, b: str, lens: Lens, wand: Body) -> TwoView | None:
    """The motion by the essential matrix, its scale by the wand's lengths; None where it can't be told."""
    gate = GATE_PX / ((lens.fx + lens.fy) / 2)
    E, mask = cv2.findEssentialMat(shared.xy_a, shared.xy_b, np.eye(3), cv2.RANSAC, 0.9999, gate)[:2]
    if E is None or E.shape != (3, 3):
        return None
    _, R, t, mask = cv2.recoverPose(E, shared.xy_a, shared.xy_b, np.eye(3), mask=mask)[:4]
    T_b_a = np.eye(4)
    T_b_a[:3, :3], T_b_a[:3, 3] = R, t.ravel()
    T = invert(T_b_a)
    good = mask.ravel() > 0
    if not good.any():
        return None
    points = intersect_rays(T, shared.xy_a[good], shared.xy_b[good])
    instant, label = shared.instant[good], shared.label[good]
    scale = _scale(points, instant, label, wand)
    T[:3, 3] *= scale or 1.0
    points = points * (scale or 1.0)
    depths: dict[tuple[str, int, int], float] = {}
    for camera, seen in ((a, points), (b, transform(invert(T), points))):
        far = np.linalg.norm(seen, axis=1).tolist()
        depths |= dict(
            zip(zip([camera] * len(far), instant.tolist(), label.tolist(), strict=True), far, strict=True)
        )
    return TwoView(a, b, T, len(np.unique(instant)), scale is not None, depths)


def intersect_rays(T_a_b: Array, xy_a: Array, xy_b: Array) -> Array:
    """Points (n, 3), camera a's frame, seen at (n, 2) image plane coordinates in two cameras (linear triangulation)."""
    P_a, P_b = np.eye(4)[:3], invert(T_a_b)[:3]
    homogeneous = cv2.triangulatePoints(P_a, P_b, xy_a.T, xy_b.T).T
    return np.asarray(homogeneous[:, :3] / homogeneous[:, 3:], float)


def _scale(points: Array, instant: NDArray[np.intp], label: NDArray[np.intp], wand: Body) -> float | None:
    """What to multiply the points with so that the wand has its length; None for a wand of one marker."""
    where = {key: row for row, key in enumerate(zip(instant.tolist(), label.tolist(), strict=True))}
    ratios = [
        np.linalg.norm(wand.points[i] - wand.points[j]) / np.linalg.norm(points[row] - points[where[k, j]])
        for (k, i), row in where.items()
        for j in range(i + 1, len(wand.markers))
        if (k, j) in where
    ]
    return float(np.median(ratios)) if ratios else None
