# SPDX-License-Identifier: BSD-3-Clause
"""Which detection of a frame is which marker of the wand.

The markers look alike: their spacing tells them apart. Three detections fix where the wand would be; the size of every
roundel and the other markers confirm it or don't. What two hypotheses explain stays unlabelled. Frames of which a
marker is missing take their labels from the frames before and after. All frames of a camera are looked at at once.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibrationError
from calib.wand.detections import FrameTable, WandDetections, ranges
from calib.wand.tracks import follow
from calib.wand.two_markers import label_ends
from camera_node.arrays import Array, Index, Mask
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens

GATE_PX = 3.0  # how far a marker may be from where the others say it is
SIGMA_PX = 1.0
SIGMA_LOG_RANGE = 0.05  # of a distance that comes from a roundel's size
MAX_SIGMAS = 4.0  # a hypothesis that needs more is wrong
SIGMA_LOG_SLANT = 0.2  # where sizes are unknown: a wand is rarely as near as it is long
MARGIN = 12.0  # by which the second best must be worse; of a squared Mahalanobis distance
SYMMETRY = 0.15  # spacings that differ by less are not told apart
MAX_ROUNDELS = 40  # in one frame: more is clutter, and triples grow with the cube
BATCH = 200_000  # triples that are looked at at once


def is_collinear(points: Array) -> bool:
    """Whether (M, 3) points lie on a line, to a hundredth of their extent."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return len(points) < 3 or bool(spread[1] < 0.01 * spread[0])


def require_distinct(wand: Body) -> None:
    """Raise CalibrationError where another order of the wand's markers has nearly the same spacing."""
    points = wand.points
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    for order in permutations(range(len(points))):
        if order == tuple(range(len(points))):
            continue
        other = distances[np.ix_(order, order)]
        if (np.abs(other - distances) <= SYMMETRY * np.maximum(other, distances)).all():
            swapped = [k for k, other in enumerate(order) if k != other]
            pairs = ", ".join(
                f"{a}-{b} {distances[a, b]:.3f} m" for a, b in combinations(range(len(points)), 2)
            )
            raise CalibrationError(
                f"the wand's spacing is symmetric: markers {' and '.join(map(str, swapped))} can be swapped "
                f"(distances {pairs}); move one so that the spacings differ by {SYMMETRY:.0%} or more, "
                "or give observations with the column marker"
            )


def label(
    frames: FrameTable, seen: WandDetections, wand: Body, lenses: Sequence[Lens]
) -> tuple[WandDetections, list[Counter[str]]]:
    """The detections that are markers of the wand, labelled.

    Returns:
        labelled: its rows, at most one a frame and marker.
        left_out: the number of frames without any, by camera and reason.

    Raises:
        CalibrationError: the wand is symmetric and the detections carry no numbers.
    """
    numbered = seen.label >= 0
    labels = np.full(len(seen), -1, np.intp)
    counts = np.bincount(seen.frame, minlength=len(frames.t_s))
    few = counts < min(3, len(wand.markers))
    reason = np.where(few, "too few roundels in the frame", "no wand among the roundels").astype(object)
    if numbered.any():
        reason[counts > 0] = "no marker of the wand in the frame"
        labels = _by_number(seen, len(wand.markers))
    elif len(wand.markers) == 1:
        reason[counts > 1] = "ambiguous"
        labels[counts[seen.frame] == 1] = 0
    elif len(wand.markers) == 2:
        reason[counts == 2] = "which end is which can't be told"
        reason[counts > 2] = "ambiguous"
        labels = follow(frames, seen, label_ends(frames, seen, wand, lenses), 2)
    else:
        require_distinct(wand)
        reason[counts > MAX_ROUNDELS] = f"more than {MAX_ROUNDELS} roundels in the frame"
        _Spacing(wand, lenses, seen).label(labels, reason)
        labels = follow(frames, seen, labels, len(wand.markers))
    left_out = [Counter() for _ in lenses]
    without = np.setdiff1d(np.arange(len(frames.t_s)), seen.frame[labels >= 0])
    for camera, why in zip(frames.camera[without].tolist(), reason[without].tolist(), strict=True):
        left_out[camera][why] += 1
    rows = np.flatnonzero(labels >= 0)
    labelled = seen.select(rows)
    labelled.label[:] = labels[rows]
    return labelled, left_out


def _by_number(seen: WandDetections, markers: int) -> Index:
    """The numbers that detections carry; -1 for those that no marker has, or twice in a frame."""
    valid = (seen.label >= 0) & (seen.label < markers)
    key = np.where(valid, seen.frame * markers + seen.label, -1)
    _, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    return np.where(valid & (count[inverse] == 1), seen.label, -1)


@dataclass(frozen=True, slots=True)
class _Fits:
    """Hypotheses, one row each: the frame (by its place in the batch), the detection that each marker is or -1, what
    speaks against it, and how many markers it explains."""

    frame: Index
    rows: Index
    cost: Array
    count: Index


class _Spacing:
    """Labels all frames that hold the same number of detections at once."""

    def __init__(self, wand: Body, lenses: Sequence[Lens], seen: WandDetections) -> None:
        self.wand, self.seen = wand, seen
        self.focal = np.array([(lens.fx + lens.fy) / 2 for lens in lenses])
        self.distance = ranges(lenses, seen, wand.diameter_m)
        self.rays = seen.rays()
        self.collinear = is_collinear(wand.points)
        centred = wand.points - wand.points[0]
        axis = centred[np.argmax(np.linalg.norm(centred, axis=1))]
        self.along = centred @ axis / np.linalg.norm(axis)

    def label(self, labels: Index, reason: NDArray) -> None:
        """Write the label of every row that has one, and why frames have none."""
        for rows in self._batches():
            fits = self._hypotheses(rows)
            best, ambiguous = _choose(fits, len(rows))
            frames = self.seen.frame[rows[:, 0]]
            reason[frames[ambiguous]] = "ambiguous"
            fit, marker = np.nonzero(fits.rows[best] >= 0)
            labels[rows[fits.frame[best][fit], fits.rows[best][fit, marker]]] = marker

    def _batches(self) -> Iterator[Index]:
        """(F, n) rows of frames of n detections."""
        first = np.flatnonzero(np.diff(self.seen.frame, prepend=-1))
        size = np.diff(first, append=len(self.seen))
        for n in np.unique(size[(size >= 3) & (size <= MAX_ROUNDELS)]).tolist():
            starts = first[size == n]
            step = max(BATCH // (n * (n - 1) * (n - 2)), 1)
            for k in range(0, len(starts), step):
                yield starts[k : k + step, None] + np.arange(n)

    def _hypotheses(self, rows: Index) -> _Fits:
        """Hypotheses in which some three detections of a frame are some three markers."""
        triples = np.array(list(permutations(range(rows.shape[1]), 3)), np.intp)
        order = np.argsort(self.along, kind="stable").tolist()
        found = [
            self._confirm(rows, np.array(labels), *place(np.array(labels), rows, triples))
            for labels in combinations(order, 3)
            for place in [self._on_line if self.collinear else self._by_p3p]
        ]
        return _Fits(*(np.concatenate([getattr(f, name) for f in found]) for name in _Fits.__slots__))

    def _on_line(self, labels: Index, rows: Index, triples: Index) -> tuple[Array, Index, Index]:
        xy = self.seen.xy[rows]
        a, b, c = (xy[:, triples[:, k]] for k in range(3))
        chord = c - a
        length = np.maximum(np.linalg.norm(chord, axis=2), 1e-12)
        off = np.abs(chord[..., 0] * (b - a)[..., 1] - chord[..., 1] * (b - a)[..., 0]) / length
        share = ((b - a) * chord).sum(axis=2) / length**2
        focal = self.focal[self.seen.camera[rows[:, 0]]][:, None]
        frame, triple = np.nonzero((off * focal < GATE_PX) & (share > 0) & (share < 1))
        anchor, direction = place_on_line(
            self.rays[rows[frame[:, None], triples[triple]]], self.along[labels]
        )
        wands = anchor[:, None] + self.along[None, :, None] * direction[:, None]
        good = np.isfinite(wands).all(axis=(1, 2))
        return wands[good], frame[good], triples[triple[good]]

    def _by_p3p(self, labels: Index, rows: Index, triples: Index) -> tuple[Array, Index, Index]:
        """Poses by P3P of the triples whose roundel sizes put them as far apart as the markers are."""
        corners = self.wand.points[labels]
        distances = self.distance[rows][:, triples]
        seen = self.rays[rows][:, triples] * distances[..., None]
        known = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        apart = np.linalg.norm(seen - np.roll(seen, 1, axis=2), axis=3)
        slack = 0.2 * known + 3 * SIGMA_LOG_RANGE * distances.mean(axis=2, keepdims=True)
        wands, where = [], []
        for frame, triple in np.argwhere(~(np.abs(apart - known) > slack).any(axis=2)).tolist():
            xy = self.seen.xy[rows[frame, triples[triple]]]
            _, turns, shifts = cv2.solveP3P(corners, xy, np.eye(3), np.zeros(4), cv2.SOLVEPNP_AP3P)
            for turn, shift in zip(turns, shifts, strict=True):
                wands.append(self.wand.points @ cv2.Rodrigues(turn)[0].T + shift.ravel())
                where.append((frame, triple))
        points = np.array(wands).reshape(-1, len(self.wand.markers), 3)
        frame, triple = np.array(where, np.intp).reshape(-1, 2).T
        return points, frame, triples[triple]

    def _confirm(self, rows: Index, labels: Index, points: Array, frame: Index, triple: Index) -> _Fits:
        """The hypotheses that explain their frame, with the markers that they were not made from."""
        count, every = len(points), np.arange(len(points))
        focal = self.focal[self.seen.camera[rows[frame, 0]]]
        with np.errstate(divide="ignore", invalid="ignore"):
            expected = points[:, :, :2] / points[:, :, 2:]
        off = np.linalg.norm(self.seen.xy[rows[frame]][:, None] - expected[:, :, None], axis=3)
        off = np.where(np.isfinite(off), off * focal[:, None, None], np.inf)
        chosen = np.full((count, len(self.wand.markers)), -1, np.intp)
        chosen[:, labels] = triple
        free = np.ones((count, rows.shape[1]), bool)
        free[every[:, None], triple] = False
        for marker in np.setdiff1d(np.arange(len(self.wand.markers)), labels):
            away = np.where(free, off[:, marker], np.inf)
            nearest = away.argmin(axis=1)
            near = away[every, nearest] < GATE_PX
            chosen[near, marker] = nearest[near]
            free[every[near], nearest[near]] = False
        known = chosen >= 0
        miss = np.where(known, np.take_along_axis(off, np.maximum(chosen, 0)[:, :, None], axis=2)[:, :, 0], 0)
        prior = self._prior(points, self.distance[rows[frame[:, None], np.maximum(chosen, 0)]], known)
        good = (points[:, :, 2] > 0).all(axis=1) & (miss < GATE_PX).all(axis=1)
        good &= (prior <= MAX_SIGMAS**2).all(axis=1)
        cost = ((miss / SIGMA_PX) ** 2).sum(axis=1) + prior.sum(axis=1)
        return _Fits(frame[good], chosen[good], cost[good], known[good].sum(axis=1))

    def _prior(self, points: Array, distance: Array, known: Mask) -> Array:
        """(H, M) squared sigmas by which sizes disagree; where they are not known, by which the wand is slanted."""
        far = np.linalg.norm(points, axis=2)
        sizes = np.where(known, (np.log(distance / far) / SIGMA_LOG_RANGE) ** 2, 0.0)
        slant = np.zeros_like(sizes)
        slant[:, 0] = (np.log(far.max(axis=1) / far.min(axis=1)) / SIGMA_LOG_SLANT) ** 2
        return np.where(np.isfinite(sizes).all(axis=1, keepdims=True), sizes, slant)


def _choose(fits: _Fits, frames: int) -> tuple[Index, Index]:
    """The fit that explains most of each frame at the least cost; and the frames where another does as well."""
    most = np.zeros(frames, np.intp)
    np.maximum.at(most, fits.frame, fits.count)
    rows = np.flatnonzero(fits.count == most[fits.frame])
    rows = rows[np.lexsort((fits.cost[rows], fits.frame[rows]))]
    first = np.flatnonzero(np.diff(fits.frame[rows], prepend=-1))
    best = np.repeat(rows[first], np.diff(first, append=len(rows)))
    rival = (fits.rows[rows] != fits.rows[best]).any(axis=1) & (fits.cost[rows] < fits.cost[best] + MARGIN)
    ambiguous = np.unique(fits.frame[rows[rival]])
    best = rows[first]
    return best[~np.isin(fits.frame[best], ambiguous)], ambiguous


def place_on_line(rays: Array, along: Array) -> tuple[Array, Array]:
    """Where three points of a straight line stand, from one view and their places on the line.

    The middle point divides the outer two in a known ratio, so s02 l1 r1 = s12 l0 r0 + s01 l2 r2 for the distances l
    along the rays r: the null vector of three columns gives l up to scale, and the line's length fixes that.

    Args:
        rays: (H, 3, 3) viewing rays, one row a point, of H triples.
        along: (3,) places of the points on the line, metres, ascending.

    Returns:
        anchors: (H, 3) the point at place 0, camera frame, metres.
        directions: (H, 3) unit directions of the line. NaN in both where a distance would be negative.
    """
    t0, t1, t2 = along
    columns = np.stack([(t2 - t1) * rays[:, 0], (t0 - t2) * rays[:, 1], (t1 - t0) * rays[:, 2]], axis=-1)
    distances = np.linalg.svd(columns)[2][:, -1]
    distances = distances * np.sign(distances.sum(axis=1, keepdims=True))
    first, last = distances[:, :1] * rays[:, 0], distances[:, 2:] * rays[:, 2]
    length = np.linalg.norm(last - first, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        direction = (last - first) / length
        anchor = first / length * (t2 - t0) - t0 * direction
    bad = ~((distances > 0).all(axis=1) & (length[:, 0] > 1e-12))
    anchor[bad], direction[bad] = np.nan, np.nan
    return anchor, direction
