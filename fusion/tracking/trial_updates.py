# SPDX-License-Identifier: BSD-3-Clause
"""Trial updates: how well detections fit a robot at a possible start, each start independent of the others.

Such a body has so many distances that three or four markers fit some of them by chance, in particular while it moves
and free-running cameras triangulate it with errors of centimetres. But a true fit also predicts where each camera sees
the other markers, including those that no second camera sees.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from camera_node.foundation.arrays import Array, Index, Mask
from fusion import _core
from fusion.model.observations import (
    Assignments,
    CameraArray,
    DetectionTable,
    Discs,
    MarkerTable,
    MatchedObservations,
    Views,
    mean_by_body,
)
from fusion.model.states import OMEGA, VELOCITY, States
from fusion.tracking.constellation_search import Fits
from fusion.tracking.estimator import Estimator
from fusion.tracking.gating import (
    POSITION_GATE,
    START_S,
    START_SIGMAS,
    START_SIGMAS_SINGLE,
)
from fusion.tracking.identification import RefinedFits
from fusion.tracking.rays import Marker
from fusion.tracking.track_table import TrackTable

MIN_FACING, MARGIN_PX = 0.35, 30.0  # of markers that a camera is certain to see
MIN_VIEWS = 8  # expected ones, from which a share is evidence


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
    pairs, cost = expected.candidates(poses, detections.native, focal)
    marker, detection = pairs[:, _core.assign(pairs, cost, detections.frame)]
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


SMALL = 1e-3  # rad and m; a larger correction of a start is followed by another linearization
FAR_CHI2 = 50.0  # bound of a constellation's history: it may have been carried elsewhere


@dataclass(frozen=True, slots=True, eq=False)
class Starts:
    """K robots (rows) at rest, the assignments that support them, and the start of each assignment."""

    robot: Index
    states: States
    assignments: Assignments
    body: Index

    @classmethod
    def of(cls, fits: Fits, markers: list[Marker], table: MarkerTable) -> "Starts":
        """Constellations where the distances between their markers and triangulated markers agree."""
        mappings = fits.mappings
        rows = table.first[mappings.robot][:, None] + mappings.numbers
        assignments, of = _assigned([markers[p] for p in mappings.points.ravel().tolist()], rows.ravel())
        body = np.repeat(np.arange(len(fits)), mappings.points.shape[1])[of]
        return cls(mappings.robot, States.at_rest(fits.R, fits.t, START_SIGMAS), assignments, body)

    @classmethod
    def of_named(cls, robots: list[int], R: Array, p: Array, markers: list[dict[int, Marker]]) -> "Starts":
        """Robots (rows) at R (K, 3, 3) and p (K, 3), with their markers by row of the marker table."""
        rows = np.array([row for of in markers for row in of], np.intp)
        assignments, of = _assigned([marker for of in markers for marker in of.values()], rows)
        start = np.repeat(np.arange(len(markers)), [len(of) for of in markers])
        return cls(np.array(robots, np.intp), States.at_rest(R, p, START_SIGMAS), assignments, start[of])

    @classmethod
    def of_singles(
        cls, robots: Sequence[int], markers: list[Marker], rotations: Sequence[Array], table: MarkerTable
    ) -> "Starts":
        """Single-marker robots (rows) at triangulated markers, one for each, with rotations (3, 3)."""
        p = np.array([marker.position for marker in markers]).reshape(-1, 3)
        states = States.at_rest(np.array(rotations).reshape(-1, 3, 3), p, START_SIGMAS_SINGLE)
        robot = np.array(robots, np.intp)
        return cls(robot, states, *_assigned(markers, table.first[robot]))


def refine(
    estimator: Estimator, table: TrackTable, starts: Starts, detections: DetectionTable
) -> RefinedFits:
    """Update each start with its detections.

    Args:
        estimator: of all robots.
        table: robots and their last states.
        starts: of some robots; of one robot several.
        detections: of the frame set.
    """
    n, body = len(starts.robot), starts.body
    observations = MatchedObservations.of(starts.assignments, detections, table.markers).with_bodies(body)
    estimator = estimator.select(starts.robot)
    prediction = estimator.predict(starts.states, np.full(n, START_S))
    prepared = estimator.prepared(prediction.states, observations)
    fit = estimator.fit(prediction, prepared, SMALL)
    d2 = observations.misfit(fit.squared_px)
    rows = starts.robot.tolist()
    history = np.array(
        [table.history_chi2(k, p, np.zeros((3, 3))) for k, p in zip(rows, fit.states.p, strict=True)]
    )
    variance = np.diagonal(starts.states.P, axis1=1, axis2=2)
    motion = (fit.states.omega**2 / variance[:, OMEGA] + fit.states.v**2 / variance[:, VELOCITY]).sum(1)
    is_expected = (history < POSITION_GATE) & np.array([table.is_local(k) for k in rows], bool)
    return RefinedFits(
        starts.robot,
        fit.states,
        np.bincount(body, d2, n).astype(float) + np.minimum(history, FAR_CHI2) + motion,
        motion,
        mean_by_body(d2, body, n),
        is_expected,
        explained_shares(estimator.cameras, table.markers, detections, starts.robot, fit.states),
        shared_views(starts.assignments, body, detections, n),
        starts.assignments.with_residuals(fit.squared_px),
        body,
        prepared.matched,
        fit.equations,
        fit.weights,
    )


def with_noise(estimator: Estimator, fits: RefinedFits, added_px2: float) -> RefinedFits:
    """The fits with a variance, px^2, added to their detections: what contradicts may be velocities, or cameras."""
    if not added_px2:
        return fits
    estimator = estimator.select(fits.robot)
    starts = States.at_rest(fits.states.R, fits.states.p, START_SIGMAS)
    if estimator.single.any():
        single = States.at_rest(fits.states.R, fits.states.p, START_SIGMAS_SINGLE)
        starts = starts.with_rows(estimator.single, single.select(estimator.single))
    prediction = estimator.predict(starts, np.full(len(starts), START_S))
    observations = estimator.linearized(prediction.states, fits.observations.with_noise(added_px2))
    fit = estimator.fit(prediction, observations, SMALL)
    return replace(
        fits,
        states=fit.states,
        observations=observations.matched,
        equations=fit.equations,
        weights=fit.weights,
    )


def _assigned(markers: list[Marker], rows: Index) -> tuple[Assignments, Index]:
    """The detections of triangulated markers, assigned to `rows` of the marker table; and the marker of each."""
    detections = [np.empty(0, np.intp), *(marker.detections for marker in markers)]
    of = np.repeat(np.arange(len(markers)), [len(marker.detections) for marker in markers])
    return Assignments.of(np.concatenate(detections), rows[of]), of
