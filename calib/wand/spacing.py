# SPDX-License-Identifier: BSD-3-Clause
"""Labels the markers of a wand of three or more markers by their spacing.

Hypothesis and test in each frame: three detections assumed to be three markers give the pose of the wand; the sizes of
the roundels and the other markers confirm or reject it. A frame that two hypotheses explain equally well stays
unlabeled. All frames with the same number of detections are evaluated at once.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import cv2
import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import span_dimension
from calib.rig.estimation import MARGIN, MEDIAN_DEVIATION
from calib.wand.detections import WandDetections, ranges
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.foundation.columns import Columns
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens

GATE_PX = 3.0  # largest distance of a detection from the projected marker
SIGMA_PX = 1.0  # of that distance
SIGMA_LOG_RANGE = 0.05  # of the logarithm of a range computed from the size of a roundel
MAX_SIGMAS = 4.0  # of a range or of the slant, in an accepted hypothesis
SIGMA_LOG_SLANT = 0.2  # of the ratio of ranges along the wand; replaces the ranges where sizes are unknown
SYMMETRY = 0.15  # relative difference of spacings below which they are not distinguished
MIN_FRAMES = 20  # that state the spacing of a wand
MAX_ROUNDELS = 40  # in a frame: the number of triples grows with the cube
BATCH = 200_000  # triples that are evaluated at once


def require_distinct(wand: Body) -> None:
    """Raise CalibrationError if another order of the wand's markers has nearly the same spacing."""
    points = wand.points
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    for order in permutations(range(len(points))):
        other = distances[np.ix_(order, order)]
        swapped = [k for k, other in enumerate(order) if k != other]
        if swapped and (np.abs(other - distances) <= SYMMETRY * np.maximum(other, distances)).all():
            pairs = combinations(range(len(points)), 2)
            spacing = ", ".join(f"{a}-{b} {distances[a, b]:.3f} m" for a, b in pairs)
            raise CalibrationError(
                f"the wand's spacing is symmetric: markers {' and '.join(map(str, swapped))} can be swapped "
                f"(distances {spacing}); move one so that the spacings differ by {SYMMETRY:.0%} or more, "
                "or give observations with the column marker"
            )


def explain_spacing(wand: Body, detections: WandDetections, lenses: Sequence[Lens]) -> str:
    """How a straight wand of three differs from its file by its images, without the cameras' poses; empty if it fits.

    With ends at the depths zA and zC, by the sizes of their discs, a middle that divides the image of the wand at the
    share t divides the wand at t zA / (t zA + (1 - t) zC). The depths' errors have no preferred sign, so that the
    median over many frames is precise, and what all sizes have in common cancels.
    """
    if len(wand.markers) != 3 or span_dimension(wand.points) > 1 or (detections.label >= 0).any():
        return ""
    share, given = _middle_shares(detections, lenses, wand.diameter_m), _middle_share(wand)
    if len(share) < MIN_FRAMES:
        return ""
    found = float(np.median(share))
    sigma = float(np.median(np.abs(share - found))) / MEDIAN_DEVIATION / np.sqrt(len(share))
    # Sizes may err by `SIGMA_LOG_RANGE` in all frames; the derivative of a share s by log zC is s (1 - s).
    if abs(found - given) < found * (1 - found) * SIGMA_LOG_RANGE + MAX_SIGMAS * sigma:
        return ""
    length = float(np.ptp(_along(wand)))
    short = given * length
    return (
        f"the wand differs from its file: {len(share)} images show its middle roundel {short:.3f} m from the nearer "
        f"end and a length of {short / found:.3f} m, or {found * length:.3f} m and {length:.3f} m; the file has "
        f"{short:.3f} m and {length:.3f} m. Measure the wand again, and correct its file"
    )


def _along(wand: Body) -> Array:
    """(M,) the place of each marker along the wand's longest direction, metres, from its first marker."""
    centred = wand.points - wand.points[0]
    axis = centred[np.argmax(np.linalg.norm(centred, axis=1))]
    return centred @ axis / np.linalg.norm(axis)


def _middle_share(wand: Body) -> float:
    """The distance of the middle marker from the nearer end, as a share of the wand's length."""
    first, middle, last = np.sort(_along(wand))
    return float(min(middle - first, last - middle) / (last - first))


def _middle_shares(detections: WandDetections, lenses: Sequence[Lens], diameter_m: float) -> Array:
    """(n,) the same from each frame with three roundels on a line, whose sizes are known."""
    rows = np.flatnonzero((np.bincount(detections.frame) == 3)[detections.frame]).reshape(-1, 3)
    xy, rays = detections.xy[rows], detections.rays()[rows]
    z = ranges(lenses, detections, diameter_m)[rows] * rays[..., 2]
    opposite = np.stack(
        [np.linalg.norm(xy[:, (k + 1) % 3] - xy[:, (k + 2) % 3], axis=1) for k in range(3)], axis=1
    )
    middle = opposite.argmax(axis=1)  # opposite of the longest side
    each = np.arange(len(rows))
    a, b, c = (xy[each, (middle + k) % 3] for k in (1, 0, 2))
    z_a, z_c = (z[each, (middle + k) % 3] for k in (1, 2))
    focal = np.array([(lens.fx + lens.fy) / 2 for lens in lenses])[detections.camera[rows[:, 0]]]
    off, t = _divide(a, b, c)
    share = t * z_a / (t * z_a + (1 - t) * z_c)
    good = (off * focal < GATE_PX) & np.isfinite(share) & (share > 0) & (share < 1)
    return np.minimum(share, 1 - share)[good]


def _divide(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    """Distances (...) of points b (..., 2) from the lines through a and c, and the shares at which they divide them."""
    chord, to_b = c - a, b - a
    length = np.maximum(np.linalg.norm(chord, axis=-1), 1e-12)
    off = np.abs(chord[..., 0] * to_b[..., 1] - chord[..., 1] * to_b[..., 0]) / length
    return off, (to_b * chord).sum(axis=-1) / length**2


@dataclass(frozen=True, slots=True)
class _Candidates:
    """Possible poses of the wand.

    Attributes:
        points: (H, M, 3) its markers, camera frame, metres.
        frame: (H,) place of the frame in the batch.
        triple: (H, 3) places in the frame of the detections that give the pose.
    """

    points: Array
    frame: Index
    triple: Index


@dataclass(frozen=True, slots=True, eq=False)
class _Hypotheses(Columns):
    """Candidates that passed the test.

    Attributes:
        frame: (H,) place of the frame in the batch.
        assignment: (H, M) place in the frame of the detection of each marker, -1 for none.
        cost: (H,) squared Mahalanobis distance.
        explained: (H,) number of assigned markers.
    """

    frame: Index
    assignment: Index
    cost: Array
    explained: Index


def label_by_spacing(detections: WandDetections, wand: Body, lenses: Sequence[Lens]) -> tuple[Index, Index]:
    """Return the label (n,) of each detection, -1 for none, and the indices of ambiguous frames."""
    search, labels, ambiguous = (
        _PoseSearch(detections, wand, lenses),
        np.full(len(detections), -1, np.intp),
        [],
    )
    for rows in _batches(detections):
        hypotheses = search.hypotheses(rows)
        best, undecided = _choose(hypotheses, len(rows))
        ambiguous.append(detections.frame[rows[undecided, 0]])
        assignment = hypotheses.assignment[best]
        k, marker = np.nonzero(assignment >= 0)
        labels[rows[hypotheses.frame[best][k], assignment[k, marker]]] = marker
    return labels, np.concatenate([np.empty(0, np.intp), *ambiguous])


def _batches(detections: WandDetections) -> Iterator[Index]:
    """Yield rows (F, n) of frames with n detections each."""
    first = np.flatnonzero(np.diff(detections.frame, prepend=-1))
    size = np.diff(first, append=len(detections))
    for n in np.unique(size[(size >= 3) & (size <= MAX_ROUNDELS)]).tolist():
        starts = first[size == n]
        step = max(BATCH // (n * (n - 1) * (n - 2)), 1)
        for k in range(0, len(starts), step):
            yield starts[k : k + step, None] + np.arange(n)


class _PoseSearch:
    """Poses of the wand from triples of detections, tested by the other detections and by sizes."""

    def __init__(self, detections: WandDetections, wand: Body, lenses: Sequence[Lens]) -> None:
        self.detections, self.wand = detections, wand
        self.focal = np.array([(lens.fx + lens.fy) / 2 for lens in lenses])
        self.distance = ranges(lenses, detections, wand.diameter_m)
        self.rays = detections.rays()
        self.along = _along(wand)

    def hypotheses(self, rows: Index) -> _Hypotheses:
        """Return the accepted hypotheses in which three detections of a frame are three of the markers."""
        triples = np.array(list(permutations(range(rows.shape[1]), 3)), np.intp)
        order = np.argsort(self.along, kind="stable").tolist()
        solve: Callable[[Index, Index, Index], _Candidates]
        solve = self._solve_line if span_dimension(self.wand.points) < 2 else self._solve_p3p
        first, *others = (
            self._test(rows, markers, solve(markers, rows, triples))
            for markers in map(np.array, combinations(order, 3))
        )
        return first.joined(*others)

    def _solve_line(self, markers: Index, rows: Index, triples: Index) -> _Candidates:
        """Return poses of a straight wand from triples of collinear detections in the order of the markers."""
        xy = self.detections.xy[rows]
        a, b, c = (xy[:, triples[:, k]] for k in range(3))
        off, share = _divide(a, b, c)
        focal = self.focal[self.detections.camera[rows[:, 0]]][:, None]
        frame, triple = np.nonzero((off * focal < GATE_PX) & (share > 0) & (share < 1))
        rays = self.rays[rows[frame[:, None], triples[triple]]]
        anchor, direction = place_on_line(rays, self.along[markers])
        points = anchor[:, None] + self.along[None, :, None] * direction[:, None]
        good = np.isfinite(points).all(axis=(1, 2))
        return _Candidates(points[good], frame[good], triples[triple[good]])

    def _solve_p3p(self, markers: Index, rows: Index, triples: Index) -> _Candidates:
        """Return poses by P3P from triples whose distances, by the roundels' sizes, match those of the markers."""
        corners = self.wand.points[markers]
        distances = self.distance[rows][:, triples]
        points = self.rays[rows][:, triples] * distances[..., None]
        known = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        measured = np.linalg.norm(points - np.roll(points, 1, axis=2), axis=3)
        slack = 0.2 * known + 3 * SIGMA_LOG_RANGE * distances.mean(axis=2, keepdims=True)
        wands, where = [], []
        for frame, triple in np.argwhere(~(np.abs(measured - known) > slack).any(axis=2)).tolist():
            xy = self.detections.xy[rows[frame, triples[triple]]]
            _, turns, shifts = cv2.solveP3P(corners, xy, np.eye(3), np.zeros(4), cv2.SOLVEPNP_AP3P)
            for turn, shift in zip(turns, shifts, strict=True):
                wands.append(self.wand.points @ cv2.Rodrigues(turn)[0].T + shift.ravel())
                where.append((frame, triple))
        frame, triple = np.array(where, np.intp).reshape(-1, 2).T
        return _Candidates(np.array(wands).reshape(-1, len(self.wand.markers), 3), frame, triples[triple])

    def _test(self, rows: Index, markers: Index, candidates: _Candidates) -> _Hypotheses:
        """Return the candidates whose markers all project near their detections and fit the sizes."""
        points, frame = candidates.points, candidates.frame
        distance_px = self._pixel_distances(rows, candidates)
        assignment = _assign(distance_px, markers, candidates.triple)
        known, place = assignment >= 0, np.maximum(assignment, 0)
        error_px = np.take_along_axis(distance_px, place[:, :, None], axis=2)[:, :, 0]
        error_px = np.where(known, error_px, 0)
        prior = self._prior(points, self.distance[rows[frame[:, None], place]], known)
        good = (points[:, :, 2] > 0).all(axis=1) & (error_px < GATE_PX).all(axis=1)
        good &= (prior <= MAX_SIGMAS**2).all(axis=1)
        cost = ((error_px / SIGMA_PX) ** 2).sum(axis=1) + prior.sum(axis=1)
        return _Hypotheses(frame[good], assignment[good], cost[good], known[good].sum(axis=1))

    def _pixel_distances(self, rows: Index, candidates: _Candidates) -> Array:
        """Return (H, M, n) distances of the frame's detections from the projected markers, pixels."""
        points, rows = candidates.points, rows[candidates.frame]
        with np.errstate(divide="ignore", invalid="ignore"):
            expected = points[:, :, :2] / points[:, :, 2:]
        off = np.linalg.norm(self.detections.xy[rows][:, None] - expected[:, :, None], axis=3)
        focal = self.focal[self.detections.camera[rows[:, 0]]]
        return np.where(np.isfinite(off), off * focal[:, None, None], np.inf)

    def _prior(self, points: Array, distance: Array, known: Mask) -> Array:
        """Return (H, M) squared deviations of the ranges, in sigmas; of the slant where a size is unknown."""
        far = np.linalg.norm(points, axis=2)
        sizes = np.where(known, (np.log(distance / far) / SIGMA_LOG_RANGE) ** 2, 0.0)
        slant = np.zeros_like(sizes)
        slant[:, 0] = (np.log(far.max(axis=1) / far.min(axis=1)) / SIGMA_LOG_SLANT) ** 2
        return np.where(np.isfinite(sizes).all(axis=1, keepdims=True), sizes, slant)


def _assign(distance_px: Array, markers: Index, triple: Index) -> Index:
    """Return (H, M) the detection of each marker: `triple` (H, 3) for `markers` (3,), else the nearest free one."""
    count, total, n = distance_px.shape
    assignment, every = np.full((count, total), -1, np.intp), np.arange(count)
    assignment[:, markers] = triple
    free = np.ones((count, n), bool)
    free[every[:, None], triple] = False
    for marker in np.setdiff1d(np.arange(total), markers):
        distance = np.where(free, distance_px[:, marker], np.inf)
        nearest = distance.argmin(axis=1)
        near = distance[every, nearest] < GATE_PX
        assignment[near, marker] = nearest[near]
        free[every[near], nearest[near]] = False
    return assignment


def _choose(hypotheses: _Hypotheses, frames: int) -> tuple[Index, Index]:
    """Return the hypothesis of each frame that explains most markers at the least cost, and the ambiguous frames.

    A frame is ambiguous if a different assignment explains as many markers at a cost less than MARGIN higher.
    """
    most = np.zeros(frames, np.intp)
    np.maximum.at(most, hypotheses.frame, hypotheses.explained)
    rows = np.flatnonzero(hypotheses.explained == most[hypotheses.frame])
    rows = rows[np.lexsort((hypotheses.cost[rows], hypotheses.frame[rows]))]
    frame, assignment, cost = hypotheses.frame, hypotheses.assignment, hypotheses.cost
    first = np.flatnonzero(np.diff(frame[rows], prepend=-1))
    best = np.repeat(rows[first], np.diff(first, append=len(rows)))
    rival = (assignment[rows] != assignment[best]).any(axis=1) & (cost[rows] < cost[best] + MARGIN)
    ambiguous = np.unique(frame[rows[rival]])
    best = rows[first]
    return best[~np.isin(frame[best], ambiguous)], ambiguous


def place_on_line(rays: Array, along: Array) -> tuple[Array, Array]:
    """Locate three points of known spacing on a line from one view.

    The middle point divides the outer two in a known ratio, so s02 l1 r1 = s12 l0 r0 + s01 l2 r2 for the distances l
    along the rays r. The null vector of the three columns gives l up to scale; the length of the line gives the scale.

    Args:
        rays: (H, 3, 3) viewing rays of H triples, one row per point.
        along: (3,) positions of the points on the line, metres, ascending.

    Returns:
        anchors: (H, 3) the point at position 0, camera frame, metres.
        directions: (H, 3) unit directions of the line. Both are NaN if a distance would be negative.
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
