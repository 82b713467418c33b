# SPDX-License-Identifier: BSD-3-Clause
"""Decides which markers of a robot its detections are, where its prediction does not tell them apart.

Association gates each marker by itself. After an interruption, or with slow cameras, the gates of a robot's markers
overlap, and three detections in one camera fit any labeling exactly, so that no residual shows a wrong one. But the
errors of a prediction displace all markers of a robot together. So the labelings are compared by the joint likelihood
of all detections of the robot and its prediction, each after an update of its own (joint compatibility: Neira and
Tardos 2001). Only pairs are used that all labelings have whose probability is not far below that of the best. Where
the model explains none, as with errors of cameras that the rig does not state, or a robot that was carried, it can't
compare them, and the detections stay as they were assigned.

Where a rotation is not known to half a radian, or a robot may be elsewhere, detections are only used if they check each
other: otherwise nothing would show that they are labeled wrongly, or those of another robot.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.stats import chi2

from camera_node.foundation.arrays import Array, Index, Mask
from fusion import _core
from fusion.model.observations import (
    Assignments,
    CameraArray,
    DetectionTable,
    MarkerTable,
    MatchedObservations,
    count_checked,
    detection_density,
)
from fusion.tracking.estimator import Estimator, Prediction
from fusion.tracking.rays import GATE

MISSED = np.log(0.1)  # 1 - P_D of a marker that was usually seen
# Bounds of the time of a frame set: a comparison of 100 labelings took 6 ms of a core. Of more, as after a start of
# many robots, these are the most doubtful ones, and the others stay as assigned.
MAX_LABELINGS = 100
MAX_OF_VIEW, MAX_STEPS = 64, 5_000  # labelings of one view, and steps of their search
# Probability of the cost of a labeling below which it contradicts the model. A robot carried by 0.3 m had 5e-7;
# with 1e-3 some right labelings of sparse frame sets were not compared.
IMPOSSIBLE = 1e-5
ROUNDS = 3  # in which better labelings replace those before


@dataclass(frozen=True, slots=True, eq=False)
class Labelings:
    """L other assignments of the markers that a frame shows of a robot.

    Attributes:
        robot, frame: (L,) the view.
        margin: (L,) by how much twice the negative log-likelihood of the frame is higher, each marker by itself.
        number: (K,) the labeling of each pair, ascending.
        detection: (K,) rows of detections.
        marker: (K,) rows of the marker table.
    """

    robot: Index
    frame: Index
    margin: Array
    number: Index
    detection: Index
    marker: Index

    def __len__(self) -> int:
        return len(self.robot)

    @classmethod
    def none(cls) -> "Labelings":
        """No labeling."""
        no = np.empty(0, np.intp)
        return cls(no, no, np.empty(0), no, no, no)

    def select(self, chosen: Mask) -> "Labelings":
        """Those of a mask (L,)."""
        pairs = chosen[self.number]
        number = (np.cumsum(chosen) - 1)[self.number[pairs]]
        views = self.robot[chosen], self.frame[chosen], self.margin[chosen]
        return Labelings(*views, number, self.detection[pairs], self.marker[pairs])

    def joined(self, *others: "Labelings") -> "Labelings":
        """These, then the others."""
        parts = self, *others
        first = np.cumsum([0, *map(len, parts)])
        return Labelings(
            np.concatenate([part.robot for part in parts]),
            np.concatenate([part.frame for part in parts]),
            np.concatenate([part.margin for part in parts]),
            np.concatenate([part.number + k for part, k in zip(parts, first, strict=False)]),
            np.concatenate([part.detection for part in parts]),
            np.concatenate([part.marker for part in parts]),
        )


def find_labelings(
    cameras: CameraArray,
    detections: DetectionTable,
    pairs: Index,
    cost: Array,
    robot: Index,
    chosen: Index,
) -> Labelings:
    """The other labelings of frames that are hardly less probable, each marker by itself.

    Args:
        cameras: cameras of the rig.
        detections: of the frames.
        pairs: (2, K) rows of the marker table and of detections, by ascending marker.
        cost: (K,) of the pairs, twice their negative log-likelihoods per pixel^2 without the factors of pi.
        robot: (K,) of the pairs.
        chosen: columns of `pairs`.
    """
    n = np.max(robot, initial=0) + 1
    of_detection = pairs[1] * n + robot
    shared = np.bincount(of_detection)[of_detection] > 1
    if not shared.any():
        return Labelings.none()
    frame = detections.frame[pairs[1]]
    cost = cost + 3 * np.log(2 * np.pi) - unpaired_cost(cameras, detections)[frame]
    view = frame * n + robot
    owner = np.full(len(detections), -1)
    owner[pairs[1, chosen]] = chosen
    vague = _vague_views(pairs, cost, frame * (np.max(pairs[0]) + 1) + pairs[0], owner, view, shared)
    of = owner[pairs[1]]
    # Pairs of detections that no other robot has.
    free = np.flatnonzero(np.isin(view, vague) & ((of < 0) | (view[of] == view)))
    free = free[np.argsort(view[free], kind="stable")]
    place = np.searchsorted(vague, view[free])  # of the view of each
    is_own = of[free] == free
    own = np.bincount(place, is_own, len(vague)).astype(np.intp)
    present = np.bincount(place, np.where(is_own, cost[free], 0.0), len(vague))
    first, (marker, detection) = np.searchsorted(place, np.arange(len(vague) + 1)), pairs[:, free]
    at, total, number, rows = _core.labelings(
        first,
        marker,
        detection,
        cost[free],
        own - 1,
        np.asarray(present + GATE, float),
        MAX_STEPS,
        MAX_OF_VIEW,
    )
    found = Labelings(
        vague[at] % n, vague[at] // n, total - present[at], number, detection[rows], marker[rows]
    )
    n_own, n_pairs = np.bincount(number, is_own[rows], len(at)), np.bincount(number, minlength=len(at))
    return found.select((n_own < own[at]) | (n_pairs > own[at]))


def choose_labelings(
    estimator: Estimator,
    markers: MarkerTable,
    prediction: Prediction,
    needed: Index,
    detections: DetectionTable,
    assignments: Assignments,
    labelings: Labelings,
) -> Assignments:
    """The assignments with the best labelings, without pairs that others, hardly less probable, do not have.

    Args:
        estimator: of all robots.
        markers: of all robots.
        prediction: of all robots.
        needed: (R,) see `TrackTable.needed_detections`.
        detections: of a frame set.
        assignments: of the frame set.
        labelings: others that may be right.
    """
    robot, camera = markers.robot[assignments.marker], detections.camera[assignments.detection]
    assignments = assignments.select(~are_unchecked(needed, robot, camera)[robot])
    if not len(labelings):
        return assignments
    others = labelings.select(np.isin(labelings.robot, markers.robot[assignments.marker]))
    if not len(others):
        return assignments
    others = others.select(np.isin(np.arange(len(others)), np.argsort(others.margin)[:MAX_LABELINGS]))
    margins_of = partial(_margins, estimator, markers, prediction, detections)
    margins = margins_of(assignments, others)
    for _ in range(ROUNDS):
        better = _best_of_robots(others, margins)
        if not better.any():
            break
        present = list[Labelings]()
        for k in np.flatnonzero(better):
            assignments, before = _exchange(
                markers, detections, assignments, others.select(np.arange(len(others)) == k)
            )
            present.append(before)
        changed = others.robot[better]
        others, margins = others.select(~better).joined(*present), margins[~better]
        again = np.isin(others.robot, changed)
        margins = np.concatenate([margins, np.empty(len(present))])
        margins[again] = margins_of(assignments, others.select(again))
    return assignments.select(~_is_undecided(markers, detections, assignments, others.select(margins < GATE)))


def are_unchecked(needed: Index, robot: Index, camera: Index) -> Mask:
    """(R,) robots that have fewer of these detections (N,) by two cameras than they need."""
    unchecked: Mask = needed > 0
    return unchecked & (count_checked(robot, camera, len(needed)) < needed) if unchecked.any() else unchecked


def _margins(
    estimator: Estimator,
    markers: MarkerTable,
    prediction: Prediction,
    detections: DetectionTable,
    assignments: Assignments,
    others: Labelings,
) -> Array:
    """(L,) by how much the costs of the robots are higher with each of L other labelings: twice the negative logarithms
    of the probabilities of all detections, given the prediction, by Laplace's approximation; infinite for those that
    contradict the prediction or each other."""
    robots, at = np.unique(others.robot, return_inverse=True)
    bodies = np.concatenate([robots, others.robot])
    body, tried = _tried(markers, detections, assignments, robots, others)
    observations = MatchedObservations.of(tried, detections, markers).with_bodies(body)
    estimator, states = estimator.select(bodies), prediction.states.select(bodies)
    prepared = estimator.prepared(states, observations)
    fit = estimator.fit(Prediction(states, prediction.information[bodies], prediction.motion), prepared)
    seen = prepared.matched.detections
    noise = np.linalg.slogdet(np.moveaxis(seen.cov, 2, 0))[1] + 2 * np.log(2 * np.pi)
    of_none = unpaired_cost(estimator.cameras, detections)[seen.frame]
    cost = fit.cost + np.bincount(body, noise - of_none, len(bodies)) - np.linalg.slogdet(fit.states.P)[1]
    most = chi2.isf(IMPOSSIBLE, 2 * np.maximum(np.bincount(body, minlength=len(bodies)), 1))
    n = len(robots)
    margins: Array = np.where(fit.cost < most, cost, np.inf)[n:] - cost[at]
    return margins


def _tried(
    markers: MarkerTable,
    detections: DetectionTable,
    assignments: Assignments,
    robots: Index,
    others: Labelings,
) -> tuple[Index, Assignments]:
    """The assignments of robots, and those of the robots of other labelings with one view labeled otherwise; and the
    number of the robot or labeling of each."""
    own = assignments.select(np.isin(markers.robot[assignments.marker], robots))
    robot, frame = markers.robot[own.marker], detections.frame[own.detection]
    of_other_views = (robot == others.robot[:, None]) & (frame != others.frame[:, None])
    labeling, row = np.nonzero(of_other_views)
    body = np.concatenate(
        [np.searchsorted(robots, robot), *(len(robots) + k for k in (labeling, others.number))]
    )
    tried = own.joined(own.select(row), Assignments.of(others.detection, others.marker))
    order = np.argsort(body, kind="stable")
    return body[order], tried.select(order)


def _best_of_robots(others: Labelings, margins: Array) -> Mask:
    """(L,) of each robot the labeling that is better than the present one, if there is one, and than the others."""
    best = np.zeros(len(others), bool)
    order = np.argsort(margins)
    best[order[np.unique(others.robot[order], return_index=True)[1]]] = True
    return best & (margins < 0)


def _exchange(
    markers: MarkerTable, detections: DetectionTable, assignments: Assignments, other: Labelings
) -> tuple[Assignments, Labelings]:
    """The assignments with one other labeling of a view, whose detections others lose; and the labeling before."""
    robot, frame = markers.robot[assignments.marker], detections.frame[assignments.detection]
    own = (robot == other.robot) & (frame == other.frame)
    number = np.zeros(own.sum(), np.intp)
    before = replace(
        other, number=number, detection=assignments.detection[own], marker=assignments.marker[own]
    )
    rest = assignments.select(~own & ~np.isin(assignments.detection, other.detection))
    joined = rest.joined(Assignments.of(other.detection, other.marker))
    return joined.select(np.argsort(joined.detection, kind="stable")), before


def _is_undecided(
    markers: MarkerTable, detections: DetectionTable, assignments: Assignments, possible: Labelings
) -> Mask:
    """(N,) assignments that not all possible labelings of their views have."""
    n = len(detections.exposures.camera)
    view = markers.robot[assignments.marker] * n + detections.frame[assignments.detection]
    others = possible.robot * n + possible.frame
    n_others = np.bincount(others, minlength=np.max(view, initial=0) + 1)
    marker = np.full(len(detections), -1)
    marker[assignments.detection] = assignments.marker
    shared = possible.detection[marker[possible.detection] == possible.marker]
    undecided: Mask = np.bincount(shared, minlength=len(detections))[assignments.detection] < n_others[view]
    return undecided


def _vague_views(
    pairs: Index, cost: Array, of_marker: Index, owner: Index, view: Index, shared: Mask
) -> Index:
    """The views whose chosen pairs may be wrong, since predictions do not tell markers apart: a detection is in the
    gates of two markers of one robot, and it could be exchanged at little cost.

    Args:
        pairs: see `find_labelings`.
        cost: (K,) of the pairs less that of no pair.
        of_marker, view: (K,) numbers of the marker, or of the robot, in the frame.
        owner: (N,) the chosen pair of each detection, -1 for none.
        shared: (K,) pairs whose detections are in the gates of two markers of one robot.
    """
    of, chosen = owner[pairs[1]], owner[owner >= 0]
    is_chosen = of == np.arange(len(cost))
    present, other = np.zeros(np.max(of_marker) + 1), np.zeros(np.max(of_marker) + 1)
    present[of_marker[chosen]] = cost[chosen]
    # The least that a marker costs without its pair.
    np.minimum.at(other, of_marker[~is_chosen], cost[~is_chosen])
    loss = np.where(of >= 0, other[of_marker[of]] - cost[of], 0.0)  # of the marker whose detection it is now
    possible = shared & ~is_chosen & (cost - present[of_marker] + loss < GATE)
    return np.intersect1d(view[possible], view[chosen])


def unpaired_cost(cameras: CameraArray, detections: DetectionTable) -> Array:
    """(F,) of each frame twice the negative log-likelihood, per pixel^2, of a marker without a detection and a
    detection without a marker; infinite in frames without detections."""
    density = detection_density(cameras, detections, detections.frame)
    return -2 * (MISSED + np.log(density, out=np.full(len(density), -np.inf), where=density > 0))
