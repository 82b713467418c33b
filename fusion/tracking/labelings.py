# SPDX-License-Identifier: BSD-3-Clause
"""Decides which markers of a robot its detections are, where its prediction does not tell them apart.

Association gates each marker by itself. After an interruption, or with slow cameras, the gates of a robot's markers
overlap, and three detections in one camera fit any labeling exactly, so that no residual shows a wrong one. But the
errors of a prediction displace all markers of a robot together. So the labelings are compared by the joint likelihood
of all detections of the robot and its prediction, each after an update of its own (joint compatibility: Neira and
Tardos 2001). Only pairs are used that all labelings have whose probability is not far below that of the best. Where
the model explains none, as with errors of cameras that the rig does not state, or a robot that was carried, it can't
compare them, and the detections stay as they were assigned.

Where a rotation is not known to half a radian, detections of one camera alone are not used: nothing would show that
they are labeled wrongly.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.stats import chi2

from camera_node.foundation.arrays import Array, Index, Mask
from fusion.model.observations import (
    Assignments,
    CameraArray,
    DetectionTable,
    MarkerTable,
    MatchedObservations,
    detection_density,
)
from fusion.tracking.estimator import Estimator, Prediction
from fusion.tracking.rays import GATE

MISSED = np.log(0.1)  # 1 - P_D of a marker that was usually seen
# Bounds of the time of a frame set: 64 views were searched in 20 ms of a core, 100 labelings compared in 15. Of more,
# as after a start of many robots, the others stay as assigned.
MAX_VIEWS, MAX_LABELINGS = 64, 100  # the labelings are the most doubtful ones
MAX_CHOICES, MAX_STEPS = 64, 5_000  # labelings of one view, and steps of their search
# Probability of the cost of a labeling below which it contradicts the model. A robot carried by 0.3 m had 5e-7;
# with 1e-3 some right labelings of sparse frame sets were not compared.
IMPOSSIBLE = 1e-5
ROUNDS = 3  # in which better labelings replace those before


@dataclass(frozen=True, slots=True, eq=False)
class Labeling:
    """Another assignment of the markers that a frame shows of a robot.

    Attributes:
        robot, frame: the view.
        detection: (K,) rows of detections.
        marker: (K,) rows of the marker table.
        margin: by how much twice the negative log-likelihood of the frame is higher, each marker by itself.
    """

    robot: int
    frame: int
    detection: Index
    marker: Index
    margin: float


def find_labelings(
    cameras: CameraArray,
    detections: DetectionTable,
    pairs: Index,
    cost: Array,
    robot: Index,
    chosen: Index,
) -> list[Labeling]:
    """The other labelings of frames that are hardly less probable, each marker by itself.

    The numbers of views and of labelings are bounded; what is above the bounds stays as it was assigned.

    Args:
        cameras: cameras of the rig.
        detections: of the frames.
        pairs: (2, K) rows of the marker table and of detections, by ascending marker.
        cost: (K,) of the pairs, twice their negative log-likelihoods per pixel^2 without the factors of pi.
        robot: (K,) of the pairs.
        chosen: columns of `pairs`.
    """
    frame, n = detections.frame[pairs[1]], np.max(robot, initial=0) + 1
    of_detection = pairs[1] * n + robot
    shared = np.bincount(of_detection)[of_detection] > 1
    if not shared.any():
        return []
    cost = cost + 3 * np.log(2 * np.pi) - unpaired_cost(cameras, detections)[frame]
    view = frame * n + robot
    owner = np.full(len(detections), -1)
    owner[pairs[1, chosen]] = chosen
    vague = _vague_views(pairs, cost, frame * (np.max(pairs[0]) + 1) + pairs[0], owner, view, shared)
    of = owner[pairs[1]]
    free = np.flatnonzero((of < 0) | (view[of] == view))  # pairs of detections that no other robot has
    free = free[np.argsort(view[free], kind="stable")]
    found = list[Labeling]()
    for at in vague[:: max(1, -(-len(vague) // MAX_VIEWS))].tolist():
        rows = free[slice(*np.searchsorted(view[free], [at, at + 1]))]
        own = np.flatnonzero(of[rows] == rows)
        present = float(cost[rows[own]].sum())
        for choice, total in _choices(pairs[:, rows], cost[rows], len(own) - 1, present + GATE):
            if choice != own.tolist():
                detection, marker = pairs[1, rows[choice]], pairs[0, rows[choice]]
                found.append(Labeling(at % n, at // n, detection, marker, total - present))
    return found


def choose_labelings(
    estimator: Estimator,
    markers: MarkerTable,
    prediction: Prediction,
    unknown: Mask,
    detections: DetectionTable,
    assignments: Assignments,
    labelings: Sequence[Labeling],
) -> Assignments:
    """The assignments with the best labelings, without pairs that others, hardly less probable, do not have.

    Args:
        estimator: of all robots.
        markers: of all robots.
        prediction: of all robots.
        unknown: (R,) robots that one camera alone does not locate; see `TrackTable.is_rotation_unknown`.
        detections: of a frame set.
        assignments: of the frame set.
        labelings: others that may be right.
    """
    assignments = _without_unchecked(markers, detections, assignments, unknown)
    robots = set(markers.robot[assignments.marker].tolist())
    others = [labeling for labeling in labelings if labeling.robot in robots]
    if not others:
        return assignments
    others = sorted(others, key=lambda labeling: labeling.margin)[:MAX_LABELINGS]
    margins_of = partial(_margins, estimator, markers, prediction, detections)
    margins = margins_of(assignments, others)
    for _ in range(ROUNDS):
        better = _best_of_robots(others, margins)
        if not better:
            break
        for k in better:
            assignments, others[k] = _exchange(markers, detections, assignments, others[k])
        changed = {others[k].robot for k in better}
        rows = [k for k, other in enumerate(others) if other.robot in changed]
        margins[rows] = margins_of(assignments, [others[k] for k in rows])
    robot, frame = markers.robot[assignments.marker], detections.frame[assignments.detection]
    undecided = np.zeros(len(robot), bool)
    for k in np.flatnonzero(margins < GATE).tolist():
        other, row = others[k], np.flatnonzero((robot == others[k].robot) & (frame == others[k].frame))
        pairs = np.column_stack([assignments.marker[row], assignments.detection[row]])
        shared = (pairs[:, None] == np.column_stack([other.marker, other.detection])).all(2).any(1)
        undecided[row[~shared]] = True
    return assignments.select(~undecided)


def _without_unchecked(
    markers: MarkerTable, detections: DetectionTable, assignments: Assignments, unknown: Mask
) -> Assignments:
    """Without those of robots of unknown rotation that one camera alone sees."""
    if not unknown.any():
        return assignments
    robot, camera = markers.robot[assignments.marker], detections.camera[assignments.detection]
    seen = np.zeros((len(unknown), np.max(camera, initial=0) + 1), bool)
    seen[robot, camera] = True
    return assignments.select(~(unknown & (seen.sum(1) == 1))[robot])


def _margins(
    estimator: Estimator,
    markers: MarkerTable,
    prediction: Prediction,
    detections: DetectionTable,
    assignments: Assignments,
    others: Sequence[Labeling],
) -> Array:
    """(K,) by how much the costs of the robots are higher with each of K other labelings: twice the negative logarithms
    of the probabilities of all detections, given the prediction, by Laplace's approximation; infinite for those that
    contradict the prediction or each other."""
    of_other = np.array([labeling.robot for labeling in others], np.intp)
    robots = np.unique(of_other)
    bodies = np.concatenate([robots, of_other])
    body, tried = _tried(markers, detections, assignments, robots, others)
    observations = MatchedObservations.of(tried, detections, markers).with_bodies(body)
    estimator, states = estimator.select(bodies), prediction.states.select(bodies)
    prepared = estimator.prepared(states, observations)
    fit = estimator.fit(Prediction(states, prediction.information[bodies], prediction.motion), prepared)
    noise = np.linalg.slogdet(np.moveaxis(prepared.detections.cov, 2, 0))[1] + 2 * np.log(2 * np.pi)
    of_none = unpaired_cost(estimator.cameras, detections)[prepared.detections.frame]
    cost = fit.cost + np.bincount(body, noise - of_none, len(bodies)) - np.linalg.slogdet(fit.states.P)[1]
    most = chi2.isf(IMPOSSIBLE, 2 * np.maximum(np.bincount(body, minlength=len(bodies)), 1))
    n, at = len(robots), np.searchsorted(robots, of_other)
    margins: Array = np.where(fit.cost < most, cost, np.inf)[n:] - cost[at]
    return margins


def _tried(
    markers: MarkerTable,
    detections: DetectionTable,
    assignments: Assignments,
    robots: Index,
    others: Sequence[Labeling],
) -> tuple[Index, Assignments]:
    """The assignments of robots, and those of the robots of other labelings with one view labeled otherwise; and the
    number of the robot or labeling of each."""
    robot, frame = markers.robot[assignments.marker], detections.frame[assignments.detection]
    own = {k: np.flatnonzero(robot == k) for k in robots.tolist()}
    rest = {(one.robot, one.frame): own[one.robot][frame[own[one.robot]] != one.frame] for one in others}
    none = np.empty(0, np.intp)
    parts = [(rows, none, none) for rows in own.values()]
    parts += [(rest[one.robot, one.frame], one.detection, one.marker) for one in others]
    detection = [part for rows, added, _ in parts for part in (assignments.detection[rows], added)]
    marker = [part for rows, _, added in parts for part in (assignments.marker[rows], added)]
    body = np.repeat(np.arange(len(parts)), [len(rows) + len(added) for rows, added, _ in parts])
    return body, Assignments.of(np.concatenate(detection), np.concatenate(marker))


def _best_of_robots(others: Sequence[Labeling], margins: Array) -> list[int]:
    """Of each robot the labeling that is better than the present one, if there is one, and better than the others."""
    best: dict[int, int] = {}
    for k in np.argsort(margins).tolist():
        if margins[k] < 0:
            best.setdefault(others[k].robot, k)
    return list(best.values())


def _exchange(
    markers: MarkerTable, detections: DetectionTable, assignments: Assignments, other: Labeling
) -> tuple[Assignments, Labeling]:
    """The assignments with another labeling of a view, whose detections others lose; and the labeling before."""
    robot, frame = markers.robot[assignments.marker], detections.frame[assignments.detection]
    own = (robot == other.robot) & (frame == other.frame)
    before = replace(other, detection=assignments.detection[own], marker=assignments.marker[own])
    rest = assignments.select(~own & ~np.isin(assignments.detection, other.detection))
    joined = rest.joined(Assignments.of(other.detection, other.marker))
    return joined.select(np.argsort(joined.detection, kind="stable")), before


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


def _choices(pairs: Index, cost: Array, least: int, limit: float) -> list[tuple[list[int], float]]:
    """The choices of pairs without a common row whose sum of costs is below a limit, and these sums; by depth-first
    search within `MAX_CHOICES` and `MAX_STEPS`.

    Args:
        pairs: (2, K), by ascending first row.
        cost: (K,).
        least: how many pairs a choice has at least.
        limit: of the sum.
    """
    marker, detection, costs = pairs[0].tolist(), pairs[1].tolist(), cost.tolist()
    n = len(costs)
    after = np.searchsorted(pairs[0], pairs[0], "right").tolist()  # the first pair of the next marker
    best, left = [0.0] * (n + 1), [0] * (n + 1)  # of the pairs from here on: the lowest sum, and most markers
    for k in range(n - 1, -1, -1):
        best[k] = min(best[k + 1], costs[k] + best[after[k]])
        left[k] = 1 + left[after[k]]
    found: list[tuple[list[int], float]] = []
    open_ = [(0, list[int](), 0.0)]
    for _ in range(MAX_STEPS):
        if not open_ or len(found) == MAX_CHOICES:
            break
        k, rows, total = open_.pop()
        if total + best[k] >= limit or len(rows) + left[k] < least:
            continue
        if k == n:
            found.append((rows, total))
            continue
        open_.append((k + 1, rows, total))
        if not rows or (marker[rows[-1]] != marker[k] and detection[k] not in [detection[i] for i in rows]):
            open_.append((k + 1, [*rows, k], total + costs[k]))
    return found


def unpaired_cost(cameras: CameraArray, detections: DetectionTable) -> Array:
    """(F,) of each frame twice the negative log-likelihood, per pixel^2, of a marker without a detection and a
    detection without a marker; infinite in frames without detections."""
    density = detection_density(cameras, detections, detections.frame)
    return -2 * (MISSED + np.log(density, out=np.full(len(density), -np.inf), where=density > 0))
