# SPDX-License-Identifier: BSD-3-Clause
"""Verifies the fit of a body with markers on several sides by all its views.

Such a body has so many distances that three or four markers fit some of them by chance, in particular while it moves
and free-running cameras triangulate it with errors of centimetres. But a true fit also predicts where each camera sees
the other markers, including those that no second camera sees.
"""

from dataclasses import replace

import numpy as np

from camera_node.foundation.arrays import Array, Index, Mask
from fusion.model.observations import Assignments, CameraArray, DetectionTable, Discs, MarkerTable, Views
from fusion.model.states import States
from fusion.tracking.association import assign

MIN_FACING, MARGIN_PX = 0.35, 30.0  # of markers that a camera is certain to see
MIN_VIEWS = 8  # expected ones, from which a share is evidence
# Shares of the expected views that are detected. A true fit has 1 where nothing covers the robot, one with a wrong
# marker up to 0.67, and a false one up to 0.5.
MIN_EXPLAINED, EVIDENT = 0.6, 0.8


def explained_share(
    cameras: CameraArray, markers: MarkerTable, detections: DetectionTable, robot: int, state: States
) -> float:
    """The share of the expected views of a robot in which it is detected; NaN with fewer than `MIN_VIEWS` of them.

    Args:
        cameras: cameras of the rig.
        markers: of all robots.
        detections: of a frame set.
        robot: its row.
        state: of this robot alone, at the time of the frame set.
    """
    rows = np.arange(markers.first[robot], markers.first[robot + 1])
    n_frames = len(detections.exposures.camera)
    marker, frame = np.repeat(np.arange(len(rows)), n_frames), np.tile(np.arange(n_frames), len(rows))
    discs = markers.discs(rows[marker], frame)
    discs = replace(discs, body=np.zeros_like(discs.body))
    views = cameras.views(state, detections.exposures, discs)
    certain = (views.facing > MIN_FACING) & _inside(cameras, detections, discs, views)
    if certain.sum() < MIN_VIEWS:
        return np.nan
    return float(_detected(cameras, markers, detections, rows, state)[marker, frame][certain].mean())


def _inside(cameras: CameraArray, detections: DetectionTable, discs: Discs, views: Views) -> Mask:
    """(N,) views inside their images, `MARGIN_PX` from the edges."""
    inside = np.zeros(len(discs), bool)
    for f, camera in enumerate(detections.exposures.camera.tolist()):
        lens, of = cameras[cameras.names[camera]], discs.frame == f
        uv, size = lens.project(views.q[:, of].T), np.array([lens.width, lens.height])
        inside[of] = ((uv > MARGIN_PX) & (uv < size - MARGIN_PX)).all(1)
    return inside


def _detected(
    cameras: CameraArray, markers: MarkerTable, detections: DetectionTable, rows: Index, state: States
) -> Mask:
    """(M, F) whether a detection of a frame is assigned to a marker."""
    exposures = detections.exposures
    expected = markers.expected(rows, state, np.zeros(len(rows), np.intp))
    poses, focal = cameras.frame_poses(state, exposures), cameras.focal[exposures.camera]
    pairs, cost = expected.candidates(poses, detections.columns, focal)
    marker, detection = pairs[:, assign(pairs, cost, detections.frame)]
    detected = np.zeros((len(rows), len(exposures.camera)), bool)
    detected[marker, detections.frame[detection]] = True
    return detected


def explained_shares(
    cameras: CameraArray, markers: MarkerTable, detections: DetectionTable, robots: Index, states: States
) -> Array:
    """(K,) `explained_share` of K fits of robots (rows), each by itself; NaN for robots whose prints face one way."""
    shares = np.full(len(robots), np.nan)
    has_sides = np.bincount(markers.robot, (markers.normal[2] < 1).astype(float)) > 0
    for k in np.flatnonzero(has_sides[robots]).tolist():
        state = states.select(np.array([k]))
        shares[k] = explained_share(cameras, markers, detections, int(robots[k]), state)
    return shares


def shared_views(assignments: Assignments, body: Index, detections: DetectionTable, n: int) -> Array:
    """The share of its assigned markers that a frame detects, of the frames that detect one of them, for n fits (n,).

    Args:
        assignments: of all fits.
        body: the fit of each assignment.
        detections: of the frame set.
        n: number of fits.
    """
    n_markers = _different(assignments.marker, body, n)
    seen_in = _different(detections.frame[assignments.detection], body, n)
    share: Array = np.bincount(body, minlength=n).astype(float) / np.maximum(n_markers * seen_in, 1)
    return share


def _different(numbers: Index, body: Index, n: int) -> Index:
    """(n,) how many different numbers each fit has."""
    pairs = np.unique(np.column_stack([body, numbers]), axis=0)
    return np.asarray(np.bincount(pairs[:, 0], minlength=n), np.intp)
