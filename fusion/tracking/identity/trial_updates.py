# SPDX-License-Identifier: BSD-3-Clause
"""Trial updates: how well detections fit a robot at a possible start, each start independent of the others."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from camera_node.foundation.arrays import Array, Index
from fusion.model.observations import (
    Assignments,
    DetectionTable,
    MarkerTable,
    MatchedObservations,
    mean_by_body,
)
from fusion.model.states import States
from fusion.tracking.estimator import Estimator
from fusion.tracking.gating import (
    POSITION_GATE,
    START_S,
    START_SIGMAS,
    START_SIGMAS_SINGLE,
)
from fusion.tracking.grouping.multiview import Marker
from fusion.tracking.identity.constellation import Fits
from fusion.tracking.identity.identification import RefinedFits
from fusion.tracking.identity.single_markers import history_chi2, is_local
from fusion.tracking.identity.verification import explained_shares, shared_views
from fusion.tracking.track_table import TrackTable

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
    observations = MatchedObservations.of(starts.assignments, detections, table.markers)
    observations = replace(observations, discs=replace(observations.discs, body=body))
    estimator = estimator.select(starts.robot)
    prediction = estimator.predict(starts.states, np.full(n, START_S))
    states, residuals = estimator.update(prediction, observations, SMALL)
    d2 = observations.misfit(residuals)
    rows = starts.robot.tolist()
    history = np.array(
        [history_chi2(table, k, p, np.zeros((3, 3))) for k, p in zip(rows, states.p, strict=True)]
    )
    is_expected = (history < POSITION_GATE) & np.array([is_local(table, k) for k in rows], bool)
    return RefinedFits(
        starts.robot,
        states,
        np.bincount(body, d2, n).astype(float) + np.minimum(history, FAR_CHI2),
        mean_by_body(d2, body, n),
        is_expected,
        explained_shares(estimator.cameras, table.markers, detections, starts.robot, states),
        shared_views(starts.assignments, body, detections, n),
        starts.assignments.with_residuals(residuals),
        body,
    )


def _assigned(markers: list[Marker], rows: Index) -> tuple[Assignments, Index]:
    """The detections of triangulated markers, assigned to `rows` of the marker table; and the marker of each."""
    detections = [np.empty(0, np.intp), *(marker.detections for marker in markers)]
    of = np.repeat(np.arange(len(markers)), [len(marker.detections) for marker in markers])
    return Assignments.of(np.concatenate(detections), rows[of]), of
