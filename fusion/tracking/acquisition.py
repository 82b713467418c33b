# SPDX-License-Identifier: BSD-3-Clause
"""Acquires untracked robots from unassigned detections.

Constellations are identified by the distances between their markers and by their last positions; then robots with a
single marker, by size and reach. A marker that fits two robots equally well stays unlabeled.
"""

from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Index
from fusion._core import SLACK_PX
from fusion.model.observations import Assignments, CameraArray, DetectionTable, mean_by_body
from fusion.model.robots import Robot
from fusion.tracking.constellation_search import MIN_MARKERS, TriangulatedMarkers, search
from fusion.tracking.estimator import Estimator
from fusion.tracking.gating import MAX_CHI2
from fusion.tracking.identification import Identified, MissingConstellations, RefinedFits, WeakFits, identify
from fusion.tracking.marker_search import MarkerSearch
from fusion.tracking.named_markers import find_named
from fusion.tracking.normals import start_rotation
from fusion.tracking.rays import Marker
from fusion.tracking.single_markers import (
    Histories,
    MarkerChoice,
    choose_markers,
)
from fusion.tracking.track_table import TrackTable
from fusion.tracking.trial_updates import Starts, refine


@dataclass(frozen=True, slots=True, eq=False)
class Acquired:
    """The result of an acquisition.

    Attributes:
        fits: of the acquired robots.
        displaced: single-marker robots whose detections belong to an acquired constellation.
        assignments: of all robots, including the acquired ones.
        markers: triangulated markers that stay unlabeled.
        reasons: why the other missing robots were not acquired, by row.
        crowded: cameras whose unassigned detections were too many to search all of them.
    """

    fits: tuple[RefinedFits, ...]
    displaced: Index
    assignments: Assignments
    markers: list[Marker]
    reasons: dict[int, str]
    crowded: Index


class Acquisition:
    """Acquires robots of a track table.

    Args:
        cameras: cameras of the rig.
        estimator: of all robots.

    Attributes:
        search: finds markers among unassigned detections.
    """

    def __init__(self, cameras: CameraArray, estimator: Estimator) -> None:
        self._cameras, self._estimator = cameras, estimator
        self._turn = 0  # row of the first constellation to decide about, if there are too many fits
        self._usual = 0.0  # misfit of tracked robots, when there were some last
        self.search, self._weak = MarkerSearch(cameras), WeakFits()

    def acquire(
        self,
        table: TrackTable,
        missing: Index,
        detections: DetectionTable,
        assignments: Assignments,
        histories: Histories,
    ) -> Acquired:
        """Acquire robots.

        Args:
            table: robots, states and status.
            missing: rows of the untracked robots.
            detections: of a frame set.
            assignments: of the tracked robots.
            histories: of unlabeled markers before this frame set.
        """
        if not len(missing):
            markers, crowded = self.search.find(table.markers, 0, detections, assignments)
            return Acquired((), missing, assignments, markers, {}, crowded)
        named, left = missing[table.coded[missing]], missing[~table.coded[missing]]
        by_name, why_not = self._acquire_named(table, named, detections, assignments)
        assignments = assignments.joined(*(fits.assignments for fits in by_name))
        bodies, singles = left[~table.single[left]], left[table.single[left]]
        # A marker of a constellation may be assigned to a single-marker robot: its assignments are searched too.
        is_single = table.single[table.markers.robot[assignments.marker]] & bool(len(bodies))
        of_singles, of_bodies = assignments.select(is_single), assignments.select(~is_single)
        n_missing = int(np.isin(table.markers.robot, left).sum())
        markers, crowded = self.search.find(table.markers, n_missing, detections, of_bodies)
        plain = [m for m in markers if (detections.code[m.detections] < 0).all()]
        found, reasons = self._acquire_bodies(table, bodies, plain, detections, of_bodies)
        of_bodies = of_bodies.joined(*(fits.assignments for fits in found))
        displaced = np.unique(of_singles.marker[np.isin(of_singles.detection, of_bodies.detection)])
        assignments = of_bodies.joined(of_singles.select(~np.isin(of_singles.marker, displaced)))
        found, markers = [*by_name, *found], _without(markers, assignments)
        plain = _without(plain, assignments)
        choice = choose_markers(table, singles, plain, histories)
        if choice.pairs:
            more = self._acquire_singles(table, choice, plain, detections)
            found, markers = [*found, more], _without(markers, more.assignments)
            assignments = assignments.joined(more.assignments)
        return Acquired(
            tuple(fits for fits in found if len(fits)),
            table.markers.robot[displaced],
            assignments,
            markers,
            why_not | reasons | choice.reasons,
            crowded,
        )

    def _acquire_named(
        self, table: TrackTable, missing: Index, detections: DetectionTable, assignments: Assignments
    ) -> tuple[list[RefinedFits], dict[int, str]]:
        """The coded robots that their codes identify, and why the others are not among them."""
        if not len(missing):
            return [], {}
        free = np.setdiff1d(np.arange(len(detections)), assignments.detection)
        named = find_named(self._cameras, table, missing, detections, free)
        starts = Starts.of_named(named.robots, named.R, named.p, named.markers)
        refined = self._refine(table, starts, detections)
        fits = refined.misfit < MAX_CHI2
        poor = dict.fromkeys(
            refined.robot[~fits].tolist(), "the pictures of its codes do not fit its markers"
        )
        return [refined.select(fits)], named.reasons | poor

    def _acquire_bodies(
        self,
        table: TrackTable,
        missing: Index,
        markers: list[Marker],
        detections: DetectionTable,
        assignments: Assignments,
    ) -> tuple[list[RefinedFits], dict[int, str]]:
        """The constellations that the markers identify, and why the others are not among them."""
        if not len(missing):
            return [], {}
        self._usual = _usual_misfit(table, self._cameras, detections, assignments) or self._usual
        robots = {row: table.robots[row] for row in missing.tolist()}
        scene = TriangulatedMarkers.of(markers, self._cameras)
        question = MissingConstellations(robots, scene, search(robots, scene))
        identified = identify(
            question,
            lambda fits: self._refine(table, Starts.of(fits, markers, table.markers), detections),
            self._usual,
            self._turn,
        )
        self._turn = identified.turn
        n_frame_sets, t_ns = self.search.n_frame_sets, table.t_ns or 0
        confirmed = self._weak.confirm(identified.weak, t_ns, n_frame_sets)
        found = [*identified.fits, *confirmed]
        acquired = {k for fits in found for k in fits.robot.tolist()}
        left = [k for k in missing.tolist() if k not in acquired]
        return found, {k: _reason(table, k, question, identified) for k in left}

    def _acquire_singles(
        self, table: TrackTable, choice: MarkerChoice, markers: list[Marker], detections: DetectionTable
    ) -> RefinedFits:
        pairs = [(robot, markers[k]) for robot, k in choice.pairs.items()]
        R = [
            start_rotation(self._cameras, detections, marker, table.robots[robot].diameter_m / 2)[0]
            for robot, marker in pairs
        ]
        starts = Starts.of_singles([robot for robot, _ in pairs], [m for _, m in pairs], R, table.markers)
        refined = self._refine(table, starts, detections)
        return refined.select(refined.misfit < MAX_CHI2)

    def _refine(self, table: TrackTable, starts: Starts, detections: DetectionTable) -> RefinedFits:
        return refine(self._estimator, table, starts, detections)


def _usual_misfit(
    table: TrackTable, cameras: CameraArray, detections: DetectionTable, assignments: Assignments
) -> float:
    """The median of the mean squared residuals of tracked robots, in standard deviations, no less than the noise of
    detections explains; 0 without any. What errors of the cameras explain is not usual unless robots show it: while
    cameras contradict each other, claims contain errors of pixels, and constellations of others would fit."""
    noise = detections.variance_px2[assignments.detection]
    own = noise - cameras.error_px[detections.camera[assignments.detection]] ** 2
    d2, known = assignments.squared_px / (noise + SLACK_PX**2), np.isfinite(assignments.squared_px)
    if not known.any():
        return 0.0
    robot = table.markers.robot[assignments.marker[known]]
    means = mean_by_body(d2[known], robot, len(table.robots))[np.unique(robot)]
    return max(float(np.median(means)), float(np.median(2 * own / (noise + SLACK_PX**2))))


def _without(markers: list[Marker], assignments: Assignments) -> list[Marker]:
    """The markers none of whose detections is assigned."""
    if not markers:
        return []
    taken = set(assignments.detection.tolist())
    return [marker for marker in markers if taken.isdisjoint(marker.detections.tolist())]


def _too_few(robot: Robot, scene: TriangulatedMarkers) -> str:
    """Why a constellation has too few markers: they are not seen, or there are as many of another size."""
    others = scene.diameter_m[~scene.with_diameter(robot.diameter_m)]
    if len(others) < MIN_MARKERS:
        return f"fewer than {MIN_MARKERS} of its {len(robot.markers)} markers are seen by two cameras"
    declared_mm, seen_mm = 1e3 * robot.diameter_m, 1e3 * float(np.median(others))
    return f"declared with discs of {declared_mm:.0f} mm, but unlabeled ones measure {seen_mm:.0f} mm"


def _reason(table: TrackTable, k: int, question: MissingConstellations, identified: Identified) -> str:
    """Why constellation k was not acquired."""
    n, found = len(table.robots[k].markers), question.candidates
    if k in found.crowded:
        return "too many unlabeled markers have its distances"
    if k in identified.rivals:
        rival = identified.rivals[k]
        return "its markers fit in several places" if rival == k else f"ambiguous with {table.names[rival]}"
    if k in identified.unexplained:
        return (
            "some of its markers fit, but the cameras do not detect most of the others that they should see"
        )
    if k not in found.tables or not len(found.tables[k]):
        return _too_few(table.robots[k], question.scene)
    return f"no {MIN_MARKERS} of its {n} markers fit well anywhere"
