# SPDX-License-Identifier: BSD-3-Clause
"""Builds the bundle adjustment of a labeled recording: its frame sets, the initial motion, and the observations.

Frames of different cameras are grouped into frame sets, of which the adjustment uses those that cover the images. The
wand's position at each is triangulated from a rough rig. Points beside the wand, at unknown positions, that several
cameras see ("unpaired" or background points of easyWand and Argus) are matched in time: they may stand still or move,
and constrain the cameras where the wand is not waved.
"""

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from calib.rig.camera import transform
from calib.rig.coverage import choose_covering, spread_evenly
from calib.rig.estimation import CLEAR
from calib.rig.triangulation import intersect_images
from calib.wand.body_poses import BodyLocator, has_poses
from calib.wand.bundle_adjustment.covariance import coarse_sigma
from calib.wand.bundle_adjustment.problem import (
    AffineWand,
    BackgroundPoints,
    Estimate,
    Problem,
    State,
    WandObservations,
)
from calib.wand.bundle_adjustment.residuals import start_points
from calib.wand.detections import (
    SAME_S,
    MarkerImages,
    MarkerTrack,
    WandDetections,
    WandRecording,
    group_rows,
)
from calib.wand.trajectory import acceleration_density, finite_velocities
from camera_node.foundation.arrays import Array, Index, Mask

MIN_SIGMA_PX = 0.02  # error of every lens model, in addition to the covariance of the detector
MIN_KNOTS = 2
WINDOW = 8  # consecutive frame sets that are chosen together, so that the motion between them is estimated
CELLS = (4, 3)  # columns and rows of an image, for coverage
LENGTH_TOLERANCE = 0.25  # of a wand length: beyond, a detection is wrong
# Part of the error of a detection that is the same in all images of a point that stands still.
STILL_SIGMA_PX = 0.05
MAX_POINTS = 2000  # positions of points that are used


def build_problem(recording: WandRecording, cameras: Array, offset_s: Array, budget: int) -> Estimate | None:
    """Build the problem around a rig that is nearly right.

    Args:
        recording: labeled detections.
        cameras: (C, 4, 4) T_world_cam.
        offset_s: (C,) true time = stamp + offset.
        budget: number of frame sets to use, about.

    Returns:
        the problem with its start; None where fewer than two frame sets give the wand's position.
    """
    rows, knot, knot_s = _choose_detections(recording, offset_s, budget)
    wand, gap_s = AffineWand.of(recording.wand), recording.timing.gap_s
    markers = triangulate(recording.tracks, cameras, offset_s, knot_s, gap_s)
    basis = interpolate_missing(knot_s, solve_basis(markers, wand), gap_s)
    basis = _locate_missing(recording, basis, cameras, offset_s, knot_s)
    known = np.asarray(np.isfinite(basis).all(axis=(1, 2)))
    if known.sum() < MIN_KNOTS:
        return None
    renumbered = np.cumsum(known) - 1
    rows, knot = rows[known[knot]], renumbered[knot[known[knot]]]
    knot_s, basis = knot_s[known], basis[known]
    density = acceleration_density(knot_s, basis, gap_s)
    lens_sigma = np.array([coarse_sigma(lens) for lens in recording.lenses])
    problem = Problem(
        lenses=list(recording.lenses),
        wand=wand,
        knot_s=knot_s,
        gap_s=gap_s,
        density=density,
        middle_s=recording.middle_s,
        lens_sigma=lens_sigma,
        readout_s=recording.readout_s,
    )
    motion = np.stack([basis, finite_velocities(knot_s, basis, gap_s)], axis=1)
    state = State.of(cameras, offset_s, motion, len(wand.shapes))
    return Estimate(problem, state, _observations(recording, rows, knot))


def _locate_missing(
    recording: WandRecording, basis: Array, cameras: Array, offset_s: Array, knot_s: Array
) -> Array:
    """The basis markers (K, B, 3) at the knots: those that no two cameras saw, by the pose of the wand as a rigid
    body."""
    missing = np.flatnonzero(np.isnan(basis).any(axis=(1, 2)))
    if not len(missing) or not has_poses(recording.wand):
        return basis
    points = recording.wand.points
    locator = BodyLocator(
        recording.tracks,
        points,
        dict(enumerate(cameras)),
        dict(enumerate(offset_s.tolist())),
        recording.timing.gap_s,
    )
    unseen = knot_s[missing]
    locator.locate_by_motion(unseen[~locator.sees(unseen)])
    basis, markers = basis.copy(), points[AffineWand.of(recording.wand).basis]
    for k, allowed in zip(missing.tolist(), locator.locate(knot_s[missing]), strict=True):
        if allowed:
            basis[k] = transform(allowed[0], markers)
    return basis


def add_background(recording: WandRecording, estimate: Estimate) -> Estimate:
    """The estimate with the recording's background points, matched and located by its cameras and clocks."""
    if (images := recording.background) is None:
        return estimate
    problem, state = estimate.problem, estimate.state
    points = match_points(images, state.true_times(images, problem.middle_s), problem.gap_s)
    problem, state = start_points(problem, state, points)
    return replace(estimate, problem=problem, state=state)


def _choose_detections(recording: WandRecording, offset_s: Array, budget: int) -> tuple[Index, Index, Array]:
    """The n detections of the chosen frame sets, (n,) their knots, and (K,) the knots' times."""
    detections = recording.detections
    true_s = detections.t_s + offset_s[detections.camera]
    order = np.argsort(true_s, kind="stable")
    group = _groups(recording, true_s)
    frame_set = _frame_sets(recording, true_s, order, 1 if group.any() else 2)
    rows = order[frame_set[order] >= 0]
    sizes = np.array([(lens.width, lens.height) for lens in recording.lenses], float)
    selected, numbers = detections.select(rows), frame_set[rows]
    between = _between_groups(numbers, group[selected.camera])
    chosen = choose_frame_sets(selected, numbers, sizes, budget, between)
    rows = rows[chosen[frame_set[rows]]]
    knot = np.unique(frame_set[rows], return_inverse=True)[1]
    return rows, knot, _middle_times(true_s[rows], knot)


def _groups(recording: WandRecording, true_s: Array) -> Index:
    """(C,) the group of each camera: those of different groups never saw the wand at once, so that only its motion as a
    rigid body connects them."""
    cameras, gap_s = range(len(recording.lenses)), recording.timing.gap_s
    if not gap_s or not has_poses(recording.wand):
        return np.zeros(len(cameras), np.intp)
    times = [np.unique(true_s[recording.detections.camera == k]) for k in cameras]
    at_once = [[_covers(times[a], times[b], gap_s) for b in cameras] for a in cameras]
    return np.asarray(connected_components(np.array(at_once), directed=False)[1], np.intp)


def _covers(frame_s: Array, t_s: Array, gap_s: float) -> bool:
    """Whether any of the times (n,) lies between two frames at most `gap_s` apart."""
    after = np.searchsorted(frame_s, t_s)
    inside = (after > 0) & (after < len(frame_s))
    return bool((frame_s[after[inside]] - frame_s[after[inside] - 1] <= gap_s).any())


def _frame_sets(recording: WandRecording, true_s: Array, order: Index, least: int) -> Index:
    """(n,) the frame set of every detection, -1 where fewer than `least` cameras have a frame."""
    detections = recording.detections
    frames, first, back = np.unique(detections.frame[order], return_index=True, return_inverse=True)
    t_s, camera = true_s[order][first], detections.camera[order][first]
    by_time = np.argsort(t_s, kind="stable")
    of_frame = np.empty(len(frames), np.intp)
    of_frame[by_time] = group_frames(t_s[by_time], camera[by_time], recording.timing.spread_s, least)
    frame_set = np.empty(len(order), np.intp)
    frame_set[order] = of_frame[back]
    return frame_set


def _between_groups(frame_set: Index, group: Index) -> Index:
    """The frame sets next to one that another group of cameras saw, or that two saw, from the ascending frame sets (n,)
    of detections and the groups (n,) of their cameras."""
    first = np.flatnonzero(np.diff(frame_set, prepend=-1))
    least, most = np.minimum.reduceat(group, first), np.maximum.reduceat(group, first)
    changes = least[1:] != most[:-1]
    return np.flatnonzero((least != most) | np.append(changes, False) | np.append(False, changes))


def _middle_times(t_s: Array, knot: Index) -> Array:
    """(K,) the middle between the first and the last time of each knot: two knots are never close together."""
    low, high = np.full(knot.max() + 1, np.inf), np.full(knot.max() + 1, -np.inf)
    np.minimum.at(low, knot, t_s)
    np.maximum.at(high, knot, t_s)
    return (low + high) / 2


def _observations(recording: WandRecording, rows: Index, knot: Index) -> WandObservations:
    chosen = recording.detections.select(rows)
    columns = {field.name: getattr(chosen, field.name) for field in fields(MarkerImages)}
    columns["cov"] = chosen.cov + MIN_SIGMA_PX**2 * np.eye(2)
    return WandObservations(**columns, row=rows, knot=knot)


def group_frames(t_s: Array, camera: Index, spread_s: float, least: int = 2) -> Index:
    """The frame set of each of F frames, (F,); -1 where fewer than `least` cameras have a frame.

    A frame set is a run of frames within `spread_s`.

    Args:
        t_s: (F,) true capture times, ascending.
        camera: (F,) camera of each frame.
        spread_s: longest time between the frames of a set; 0 where only equal times are simultaneous.
    """
    sets, first, current = np.empty(len(t_s), np.intp), -np.inf, -1
    for k, t in enumerate(t_s.tolist()):
        if t - first > spread_s + SAME_S:
            first, current = t, current + 1
        sets[k] = current
    pairs = np.unique(np.column_stack([sets, camera]), axis=0)
    several = np.bincount(pairs[:, 0], minlength=1) >= least
    return np.where(several, np.cumsum(several) - 1, -1)[sets]


def choose_frame_sets(
    detections: WandDetections,
    frame_set: Index,
    sizes: Array,
    budget: int,
    wanted: Sequence[int] | Index = (),
) -> Mask:
    """Which of K frame sets to use, at most about `budget`: all, or windows of them that cover all images evenly.

    Args:
        detections: n detections in frame sets.
        frame_set: (n,) their frame set.
        sizes: (C, 2) width and height of the cameras' images.
        budget: number of frame sets.
        wanted: those whose windows are used first, up to half of the budget.
    """
    count = int(frame_set.max(initial=-1)) + 1
    if count <= budget:
        return np.ones(count, bool)
    position = np.clip(detections.uv / sizes[detections.camera], 0, 0.999)
    column, row = (position * CELLS).astype(np.intp).T
    cell = (detections.camera * CELLS[0] + column) * CELLS[1] + row
    counts = np.zeros((-(-count // WINDOW), len(sizes) * CELLS[0] * CELLS[1]))
    np.add.at(counts, (frame_set // WINDOW, cell), 1.0)
    most = budget // WINDOW
    first = np.unique(np.array(wanted, np.intp) // WINDOW)
    first = first[spread_evenly(len(first), most // 2)]
    chosen = np.repeat(choose_covering(counts, most, first), WINDOW)
    return chosen[:count]


def solve_basis(markers: Array, wand: AffineWand) -> Array:
    """Positions of the basis markers (K, B, 3) from those of all markers (K, M, 3), by least squares; NaN where the
    lengths are wrong or too few markers are known."""
    basis = np.full((len(markers), len(wand.basis), 3), np.nan)
    known = np.isfinite(markers).all(axis=2)
    for pattern in np.unique(known, axis=0):
        if np.linalg.matrix_rank(wand.weights[pattern], tol=1e-6) == len(wand.basis):
            rows = (known == pattern).all(axis=1)
            basis[rows] = np.linalg.pinv(wand.weights[pattern]) @ markers[rows][:, pattern]
    ends = basis[:, wand.pairs]
    lengths = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2)
    basis[(np.abs(lengths - wand.lengths) > LENGTH_TOLERANCE * wand.lengths).any(axis=1)] = np.nan
    return basis


def interpolate_missing(knot_s: Array, basis: Array, gap_s: float) -> Array:
    """The positions (K, B, 3) with missing ones interpolated linearly between neighbours at most `gap_s` apart."""
    known = np.flatnonzero(np.isfinite(basis).all(axis=(1, 2)))
    if len(known) < 2:
        return basis
    after = np.clip(np.searchsorted(knot_s[known], knot_s), 1, len(known) - 1)
    a, b = known[after - 1], known[after]
    share = ((knot_s - knot_s[a]) / (knot_s[b] - knot_s[a]))[:, None, None]
    near = (knot_s[b] - knot_s[a] <= gap_s)[:, None, None] & (share >= 0) & (share <= 1)
    between = np.where(near, (1 - share) * basis[a] + share * basis[b], np.nan)
    return np.where(np.isfinite(basis), basis, between)


def triangulate(
    tracks: Sequence[Sequence[MarkerTrack]], poses: Array, offset_s: Array, t_s: Array, gap_s: float
) -> Array:
    """Locate the markers at given times, robustly.

    Minimises the distances to all viewing rays, reweighted by a Cauchy kernel.

    Args:
        tracks: by camera and marker, by timestamps.
        poses: (C, 4, 4) T_world_cam.
        offset_s: (C,) true time = timestamp + offset.
        t_s: (K,) true times.
        gap_s: the longest gap over which tracks are interpolated.

    Returns:
        (K, M, 3) markers, world; NaN if fewer than two cameras saw the marker near that time, or their rays are nearly
        parallel.
    """
    xy = np.array(
        [
            [track.interpolate(t_s - offset, gap_s) for track in markers]
            for markers, offset in zip(tracks, offset_s, strict=True)
        ]
    )  # (C, M, K, 2)
    return np.swapaxes(intersect_images(xy, poses)[0], 0, 1)


def match_points(detections: WandDetections, true_s: Array, gap_s: float) -> BackgroundPoints:
    """Match images of the same position of a point in several cameras.

    A point that stands still has one position, and its images in a camera are averaged. One that moves has a position
    at each of its times; images between two frames are interpolated.

    Args:
        detections: n images of background points.
        true_s: (n,) true capture times.
        gap_s: the longest time over which images are interpolated; 0 if only frames of equal time are simultaneous.
    """
    by_number = group_rows(detections.label, int(detections.label.max(initial=-1)) + 1)
    groups = [group for rows in by_number for group in _match(detections, true_s, rows, gap_s)]
    if len(groups) > MAX_POINTS:
        groups = [groups[k] for k in spread_evenly(len(groups), MAX_POINTS)]
    if not groups:
        return BackgroundPoints.none()
    point = np.repeat(np.arange(len(groups)), [len(group.camera) for group in groups])
    return BackgroundPoints(
        point, *(np.concatenate([getattr(g, name) for g in groups]) for name in ("camera", "uv", "cov"))
    )


def _match(
    detections: WandDetections, true_s: Array, rows: Index, gap_s: float
) -> Iterator[BackgroundPoints]:
    """The images of each position of one point, whose detections are `rows`, in two cameras or more."""
    cameras = np.unique(detections.camera[rows]).tolist()
    if len(cameras) < 2:
        return
    of_camera = [rows[detections.camera[rows] == camera] for camera in cameras]
    if all(_stands_still(detections, mine) for mine in of_camera):
        images = [_average(detections, mine) for mine in of_camera]
        yield _one_point(cameras, np.array([uv for uv, _ in images]), np.array([cov for _, cov in images]))
        return
    # Where frames of equal time exist, every time counts; else those of the camera that saw the point most often.
    times = np.unique(true_s[rows]) if gap_s == 0 else np.sort(true_s[max(of_camera, key=len)])
    uv = np.array([_interpolate(detections, true_s, mine, times, gap_s) for mine in of_camera])
    cov = np.array([np.median(detections.cov[mine], axis=0) for mine in of_camera])
    known = np.isfinite(uv[:, :, 0])
    for k in np.flatnonzero(known.sum(axis=0) >= 2).tolist():
        seen = known[:, k]
        yield _one_point(np.array(cameras)[seen].tolist(), uv[seen, k], cov[seen])


def _one_point(cameras: list[int], uv: Array, cov: Array) -> BackgroundPoints:
    return BackgroundPoints(np.zeros(len(cameras), np.intp), np.array(cameras), uv, cov)


def _stands_still(detections: WandDetections, rows: Index) -> bool:
    uv, variance = detections.uv[rows], np.median(np.einsum("nii->n", detections.cov[rows])) / 2
    away = uv - np.median(uv, axis=0)
    return bool(np.median((away**2).sum(axis=1)) <= 2 * CLEAR**2 * variance)


def _average(detections: WandDetections, rows: Index) -> tuple[Array, Array]:
    """The median of the images of a point that stands still, which one of many that are wrong does not change, and its
    covariance: pi / 2 that of the mean."""
    cov = np.median(detections.cov[rows], axis=0) * (np.pi / 2 if len(rows) > 2 else 1.0) / len(rows)
    return np.median(detections.uv[rows], axis=0), cov + STILL_SIGMA_PX**2 * (len(rows) > 1) * np.eye(2)


def _interpolate(detections: WandDetections, true_s: Array, rows: Index, times: Array, gap_s: float) -> Array:
    """(k, 2) images at `times` (k,) of a point in one camera; NaN where it did not see the point about that time."""
    order = rows[np.argsort(true_s[rows], kind="stable")]
    fresh = np.diff(true_s[order], prepend=-np.inf) > SAME_S  # two images at once are no track
    order = order[fresh]
    return MarkerTrack.of(true_s[order], detections.uv[order]).interpolate(times, gap_s)
