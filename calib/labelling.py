# SPDX-License-Identifier: BSD-3-Clause
"""Which roundel of a frame is which marker of the wand.

The markers look alike: their spacing tells them apart. Three detections fix where the wand would be (`hypotheses`);
the size of every roundel and the other markers confirm it or don't. What two hypotheses explain stays unlabelled.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations, permutations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibrationError
from calib.views import View, place_on_line, ranges
from camera_node.body import Body
from camera_node.lens import Lens
from camera_node.messages import Detections
from camera_node.roundels import Roundels

Array = NDArray[np.float64]
Index = NDArray[np.intp]

GATE_PX = 3.0  # how far a marker may be from where the others say it is
SIGMA_PX = 1.0
SIGMA_LOG_RANGE = 0.05  # of a distance that comes from a roundel's size
MAX_SIGMAS = 4.0  # a hypothesis that needs more is wrong
SIGMA_LOG_SLANT = 0.2  # where sizes are unknown: a wand is rarely as near as it is long
MARGIN = 12.0  # by which the second best must be worse; of a squared Mahalanobis distance
SYMMETRY = 0.15  # spacings that differ by less are not told apart
MAX_ROUNDELS = 40  # in one frame: more is clutter, and triples grow with the cube


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


@dataclass(frozen=True)
class _Fit:
    """Detections `rows` are the markers `labels`; `points` (M, 3) is the wand in the camera's frame."""

    labels: tuple[int, ...]
    rows: tuple[int, ...]
    points: Array
    cost: float


class Labeller:
    """Labels frames of one camera."""

    def __init__(self, wand: Body, lens: Lens) -> None:
        self.wand, self.lens = wand, lens
        self.focal = (lens.fx + lens.fy) / 2
        self.collinear = is_collinear(wand.points)
        centred = wand.points - wand.points[0]
        self.axis = centred[np.argmax(np.linalg.norm(centred, axis=1))]
        self.axis = self.axis / max(float(np.linalg.norm(self.axis)), 1e-12)
        self.along = centred @ self.axis

    def label(self, message: Detections) -> View | str:
        """The wand in a frame, or the reason why it can't be told."""
        roundels = message.unpack()
        xy = self.lens.normalise(roundels.uv)
        inside = np.flatnonzero(np.isfinite(xy).all(axis=1))
        roundels, xy = roundels.select(inside), xy[inside]
        if len(roundels) > MAX_ROUNDELS:
            return f"more than {MAX_ROUNDELS} roundels in the frame"
        if (roundels.id >= 0).any():
            found = self._by_number(roundels)
        elif len(self.wand.markers) == 1:
            found = (np.array([0]), np.array([0])) if len(roundels) == 1 else self._say(len(roundels), 1)
        else:
            found = self._by_spacing(roundels, xy)
        if isinstance(found, str):
            return found
        labels, rows = found
        roundels, xy = roundels.select(rows), xy[rows]
        points = self._place(labels, roundels)
        return View(message.camera, message.t_ns, labels, roundels, xy, points)

    def _say(self, seen: int, needed: int) -> str:
        return "too few roundels in the frame" if seen < needed else "ambiguous"

    def _by_number(self, roundels: Roundels) -> tuple[Index, Index] | str:
        numbers, counts = np.unique(roundels.id, return_counts=True)
        labels = numbers[(counts == 1) & (numbers >= 0) & (numbers < len(self.wand.markers))]
        if not len(labels):
            return "no marker of the wand in the frame"
        return labels.astype(np.intp), np.array([np.flatnonzero(roundels.id == k)[0] for k in labels])

    def _by_spacing(self, roundels: Roundels, xy: Array) -> tuple[Index, Index] | str:
        if len(roundels) < 3:
            return "too few roundels in the frame"
        distances = ranges(self.lens, roundels, self.wand.diameter_m)
        rays = np.column_stack([xy, np.ones(len(xy))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        fits = [
            fit
            for labels in combinations(np.argsort(self.along, kind="stable").tolist(), 3)
            for fit in self._hypotheses(labels, rays, xy, distances)
        ]
        return self._choose(fits)

    def _choose(self, fits: list[_Fit]) -> tuple[Index, Index] | str:
        if not fits:
            return "no wand among the roundels"
        most = max(len(fit.rows) for fit in fits)
        ranked = sorted((fit for fit in fits if len(fit.rows) == most), key=lambda fit: fit.cost)
        best = dict(zip(ranked[0].labels, ranked[0].rows, strict=True))
        for fit in ranked[1:]:
            if dict(zip(fit.labels, fit.rows, strict=True)) != best and fit.cost < ranked[0].cost + MARGIN:
                return "ambiguous"
        labels = np.array(sorted(best), np.intp)
        return labels, np.array([best[k] for k in labels], np.intp)

    def _hypotheses(self, labels: tuple[int, ...], rays: Array, xy: Array, distances: Array) -> list[_Fit]:
        """Fits in which some three detections are the markers `labels`."""
        triples = np.array(list(permutations(range(len(rays)), 3)), np.intp)
        if self.collinear:
            wands, triples = self._on_line(labels, triples, rays, xy)
        else:
            wands, triples = self._by_p3p(labels, triples, xy, distances)
        return [
            fit
            for points, rows in zip(wands, triples, strict=True)
            if (fit := self._fit(points, dict(zip(labels, rows.tolist(), strict=True)), xy, distances))
        ]

    def _on_line(
        self, labels: tuple[int, ...], triples: Index, rays: Array, xy: Array
    ) -> tuple[Array, Index]:
        a, b, c = (xy[triples[:, k]] for k in range(3))
        chord = c - a
        length = np.maximum(np.linalg.norm(chord, axis=1), 1e-12)
        off = np.abs(chord[:, 0] * (b - a)[:, 1] - chord[:, 1] * (b - a)[:, 0]) / length
        share = ((b - a) * chord).sum(axis=1) / length**2
        triples = triples[(off * self.focal < GATE_PX) & (share > 0) & (share < 1)]
        anchor, direction = place_on_line(rays[triples], self.along[list(labels)])
        wands = anchor[:, None] + self.along[None, :, None] * direction[:, None]
        good = np.isfinite(wands).all(axis=(1, 2))
        return wands[good], triples[good]

    def _by_p3p(self, labels: tuple[int, ...], triples: Index, xy: Array, distances: Array):
        """Poses by P3P of the triples whose roundel sizes put them as far apart as the markers are."""
        corners = self.wand.points[list(labels)]
        rays = np.column_stack([xy, np.ones(len(xy))])
        seen = rays / np.linalg.norm(rays, axis=1, keepdims=True) * distances[:, None]
        apart = seen[triples] - np.roll(seen[triples], 1, axis=1)
        known = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        slack = 0.2 * known + 3 * SIGMA_LOG_RANGE * distances[triples].mean(axis=1, keepdims=True)
        triples = triples[~(np.abs(np.linalg.norm(apart, axis=2) - known) > slack).any(axis=1)]
        wands, rows = [], []
        for triple in triples:
            _, turns, shifts = cv2.solveP3P(corners, xy[triple], np.eye(3), np.zeros(4), cv2.SOLVEPNP_AP3P)
            for turn, shift in zip(turns, shifts, strict=True):
                wands.append(self.wand.points @ cv2.Rodrigues(turn)[0].T + shift.ravel())
                rows.append(triple)
        points = np.array(wands).reshape(-1, len(self.wand.markers), 3)
        triples = np.array(rows, np.intp).reshape(-1, 3)
        # Nearly all poses put a roundel where its size can't be: they go at once, before each is looked at.
        far = np.linalg.norm(points[:, list(labels)], axis=2)
        good = ~(np.abs(np.log(distances[triples] / far)) > MAX_SIGMAS * SIGMA_LOG_RANGE).any(axis=1)
        return points[good], triples[good]

    def _fit(self, points: Array, rows: dict[int, int], xy: Array, distances: Array) -> _Fit | None:
        """The hypothesis with the markers it was not made from, where it explains the frame; else None."""
        if (points[:, 2] <= 0).any():
            return None
        expected = points[:, :2] / points[:, 2:]
        for marker in set(range(len(points))) - set(rows):
            off = np.linalg.norm(xy - expected[marker], axis=1) * self.focal
            off[list(rows.values())] = np.inf
            if off.min() < GATE_PX:
                rows[marker] = int(off.argmin())
        labels, chosen = list(rows), list(rows.values())
        off = np.linalg.norm(xy[chosen] - expected[labels], axis=1) * self.focal
        far = np.linalg.norm(points, axis=1)
        sizes = np.log(distances[chosen] / far[labels])
        if np.isfinite(sizes).all():
            prior = (sizes / SIGMA_LOG_RANGE) ** 2
        else:
            prior = np.log(far.max() / far.min()) ** 2 / np.full(1, SIGMA_LOG_SLANT**2)
        if (off > GATE_PX).any() or (prior > MAX_SIGMAS**2).any():
            return None
        return _Fit(tuple(labels), tuple(chosen), points, float(((off / SIGMA_PX) ** 2).sum() + prior.sum()))

    def _place(self, labels: Index, roundels: Roundels) -> Array | None:
        """Where this view alone puts the labelled markers: by the wand's lengths, or by the roundels' sizes."""
        rays = self.lens.rays(roundels.uv)
        if self.collinear and len(labels) >= 3:
            order = labels[np.argsort(self.along[labels])]
            ends = order[[0, len(order) // 2, -1]]
            triple = rays[[int(np.flatnonzero(labels == k)[0]) for k in ends]]
            anchor, direction = place_on_line(triple[None], self.along[ends])
            points = anchor + self.along[labels][:, None] * direction
        else:
            points = rays * ranges(self.lens, roundels, self.wand.diameter_m)[:, None]
        return points if np.isfinite(points).all() else None


def label_views(
    messages: Iterable[Detections], wand: Body, lenses: Mapping[str, Lens]
) -> tuple[list[View], dict[str, Counter[str]]]:
    """Label every frame.

    Returns:
        views: the frames in which markers could be told apart, in the order given.
        left_out: the number of the other frames, by camera and reason.

    Raises:
        CalibrationError: the wand is symmetric and the detections carry no marker numbers.
    """
    messages = list(messages)
    if not any((message.unpack().id >= 0).any() for message in messages):
        require_distinct(wand)
    labellers = {name: Labeller(wand, lens) for name, lens in lenses.items()}
    views: list[View] = []
    left_out: dict[str, Counter[str]] = {name: Counter() for name in lenses}
    for message in messages:
        found = labellers[message.camera].label(message)
        if isinstance(found, str):
            left_out[message.camera][found] += 1
        else:
            views.append(found)
    return views, left_out
