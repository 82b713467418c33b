# SPDX-License-Identifier: BSD-3-Clause
"""Finds detections that a recording has under the wrong camera: points of two cameras swapped, or of all rotated.

Synchronous cameras: in every instant that contradicts the rig, detections are tried under other cameras, for all swaps
of two cameras and all rotations of the cameras' order; the one under which all rays meet explains it. Other cameras:
a detection that the adjustment rejects, but that is where another camera sees the marker, is of that camera.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calib.wand.bundle_adjustment.optimizer import Adjusted
from calib.wand.bundle_adjustment.problem import State, WandObservations
from calib.wand.bundle_adjustment.problem_setup import LabeledRecording
from calib.wand.bundle_adjustment.residuals import predict_markers
from calib.wand.report import Exchange
from calib.wand.tracks import intersect
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.lens import Lens

GATE = 0.01  # of an image's longer side: a detection this near to the expected place is of that camera
CLEARLY = 0.25  # of this distance, that the rays of synchronous cameras pass each other at most, if exchanged rightly
MIN_SHARE, MIN_COUNT = 0.02, 8  # of a camera's detections, from which its points count as exchanged
MIN_CAMERAS = 3  # that saw a marker at once: the rays of two meet for many exchanges


@dataclass(frozen=True, slots=True)
class FoundExchanges:
    """Detections under the wrong camera.

    Attributes:
        pairs: who shows whose points, the most frequent first.
        tested, wrong: (n,) detections of the recording that were tested, and those under the wrong camera.
    """

    pairs: list[Exchange]
    tested: Mask
    wrong: Mask


def find_exchanges(
    recording: LabeledRecording, adjusted: Adjusted, observations: WandObservations
) -> FoundExchanges | None:
    """Find the detections of a recording that are under the wrong camera; None where there are few or none."""
    count = len(recording.detections)
    tested, owner = np.zeros(count, bool), recording.detections.camera.copy()
    if recording.timing.synchronous:
        tested[:] = True
        rows, owners = _try_exchanges(recording, adjusted.state)
    else:
        tested[observations.row] = True
        rows, owners = _compare_with_motion(recording, adjusted, observations)
    owner[rows] = owners
    wrong = owner != recording.detections.camera
    pairs = _count(recording, tested, owner)
    return FoundExchanges(pairs, tested, wrong) if pairs else None


def _count(recording: LabeledRecording, tested: Mask, owner: Index) -> list[Exchange]:
    camera, names = recording.detections.camera, recording.names
    total = np.bincount(camera[tested], minlength=len(names))
    wrong = np.flatnonzero(owner != camera)
    counts = Counter(zip(camera[wrong].tolist(), owner[wrong].tolist(), strict=True))
    return [
        Exchange(str(names[shown]), str(names[of]), n / int(total[shown]))
        for (shown, of), n in counts.most_common()
        if n >= max(MIN_COUNT, MIN_SHARE * total[shown])
    ]


def _compare_with_motion(
    recording: LabeledRecording, adjusted: Adjusted, observations: WandObservations
) -> tuple[Index, Index]:
    """Rows (r,) of detections that are where another camera sees the marker, and (r,) that camera."""
    rejected, state = observations.select(~adjusted.used), adjusted.state
    if not len(rejected):
        return rejected.row, rejected.camera
    points = _interpolate_motion(adjusted, observations, rejected)
    # The other camera's frame is up to a period earlier or later: the marker is nearer than it moves in this time.
    inliers = predict_markers(adjusted.problem, observations.select(adjusted.used), state)
    speed = float(np.median(np.linalg.norm(inliers.velocity(adjusted.problem.knot_s), axis=1)))
    off, gate = np.empty((2, len(rejected), len(recording.names)))
    for camera, lens in enumerate(_lenses(recording, state)):
        T = state.cameras[camera]
        off[:, camera] = _distances(lens, T, points, rejected.uv)
        moved_m = speed * recording.timing.period_s / np.linalg.norm(points - T[:3, 3], axis=1)
        gate[:, camera] = GATE * max(lens.width, lens.height) + lens.fx * moved_m
    every, own = np.arange(len(off)), rejected.camera
    contradicts = off[every, own] > gate[every, own]
    off[every, own] = np.inf
    best = (off / gate).argmin(axis=1)
    found = contradicts & (off[every, best] < gate[every, best])
    return rejected.row[found], best[found]


def _interpolate_motion(adjusted: Adjusted, observations: WandObservations, of: WandObservations) -> Array:
    """(n, 3) positions of observed markers, world, between the nearest knots that two cameras or more determine: where
    all detections of a frame set are wrong, its own knot is."""
    problem, used = adjusted.problem, adjusted.used
    views = np.zeros((len(problem.knot_s), len(problem.lenses)), bool)
    views[observations.knot[used], observations.camera[used]] = True
    known = views.sum(axis=1) >= 2
    t_s = adjusted.state.true_times(of, problem.middle_s)
    positions = adjusted.state.motion[known, 0].reshape(int(known.sum()), -1)
    basis = np.column_stack([np.interp(t_s, problem.knot_s[known], column) for column in positions.T])
    return np.einsum("nb,nbx->nx", problem.wand.weights[of.label], basis.reshape(len(t_s), -1, 3))


def _distances(lens: Lens, T: Array, points: Array, uv: Array) -> Array:
    """(n,) pixels between the images of points (n, 3), world, and uv (n, 2); infinite behind the camera."""
    return np.nan_to_num(
        np.linalg.norm(lens.project((points - T[:3, 3]) @ T[:3, :3]) - uv, axis=1), nan=np.inf
    )


def _try_exchanges(recording: LabeledRecording, state: State) -> tuple[Index, Index]:
    """Rows (r,) of detections whose rays meet those of the others only under another camera, and (r,) that camera."""
    table = _tabulate(recording)
    cameras = len(recording.lenses)
    table = table[(table >= 0).sum(axis=1) >= MIN_CAMERAS]
    own = _misfit(recording, state, table, np.arange(cameras))
    table = table[own > GATE]
    best, choice = np.full(len(table), np.inf), np.zeros(len(table), np.intp)
    orders = list(_orders(cameras))
    for k, order in enumerate(orders):
        misfit = _misfit(recording, state, table, order)
        choice[misfit < best] = k
        best = np.minimum(best, misfit)
    found = best < CLEARLY * GATE
    owners = np.array(orders)[choice[found]]
    rows = table[found]
    moved = (rows >= 0) & (owners != np.arange(cameras))
    return rows[moved], owners[moved]


def _orders(cameras: int) -> Iterator[Index]:
    """All swaps of two cameras, and all rotations of their order: (C,) whose detections each camera shows."""
    for a, b in combinations(range(cameras), 2):
        order = np.arange(cameras)
        order[[a, b]] = b, a
        yield order
    for shift in range(1, cameras):
        yield np.roll(np.arange(cameras), shift)


def _tabulate(recording: LabeledRecording) -> Index:
    """(K, C) the detection of each camera, by instant and marker; -1 where it has none."""
    detections = recording.detections
    instant = np.unique(detections.t_s, return_inverse=True)[1]
    key = instant * len(recording.wand.markers) + detections.label
    _, place = np.unique(key, return_inverse=True)
    table = np.full((int(place.max(initial=-1)) + 1, len(recording.lenses)), -1, np.intp)
    table[place, detections.camera] = np.arange(len(detections))
    return table


def _misfit(recording: LabeledRecording, state: State, table: Index, order: Index) -> Array:
    """(K,) largest distance of the detections of each row of a table (K, C) from the point where their rays meet, if
    camera k shows the detections of camera order[k]; relative to the images' longer sides."""
    cameras, lenses = len(order), _lenses(recording, state)
    uv = recording.detections.uv
    known = np.zeros((cameras, 1, len(table)), bool)
    ray, pixels = np.zeros((cameras, 1, len(table), 3)), np.full((cameras, len(table), 2), np.nan)
    for shown in range(cameras):
        of, rows = int(order[shown]), table[:, shown]
        pixels[of] = np.where(rows[:, None] >= 0, uv[rows], np.nan)
        xy = lenses[of].normalise(np.nan_to_num(pixels[of]))
        known[of, 0] = (rows >= 0) & np.isfinite(xy).all(axis=1)
        local = np.column_stack([np.nan_to_num(xy), np.ones(len(xy))])
        ray[of, 0] = local / np.linalg.norm(local, axis=1, keepdims=True) @ state.cameras[of, :3, :3].T
    points = intersect(ray, state.cameras[:, :3, 3], known, rounds=1)[0][0]
    misfit = np.where(np.isfinite(points[:, 0]), 0.0, np.inf)
    for camera, lens in enumerate(lenses):
        seen = known[camera, 0]
        off = _distances(lens, state.cameras[camera], points[seen], pixels[camera, seen])
        misfit[seen] = np.maximum(misfit[seen], off / max(lens.width, lens.height))
    return misfit


def _lenses(recording: LabeledRecording, state: State) -> list[Lens]:
    return [state.lens(k, lens) for k, lens in enumerate(recording.lenses)]
