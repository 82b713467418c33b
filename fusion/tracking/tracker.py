# SPDX-License-Identifier: BSD-3-Clause
"""Tracks robots and unlabeled markers from frame set to frame set, live and offline. Reads no clock."""

import logging
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from calib.rig.camera import Camera
from camera_node.foundation.arrays import Index, Mask
from fusion.model.corrections import ExtrinsicsCorrection, RigRefinement
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.limits import Limits
from fusion.model.marker_places import PLACE_M
from fusion.model.observations import Assignments, CameraArray, DetectionTable, MatchedObservations
from fusion.model.robots import Robot
from fusion.model.states import FrameSetFit, Snapshot
from fusion.monitoring.camera_monitors import CameraMonitors
from fusion.monitoring.size_check import SizeCheck
from fusion.protocol.arena_health import describe_contradiction
from fusion.protocol.pose_messages import Contradiction, RobotPose
from fusion.tracking.acquisition import Acquired, Acquisition
from fusion.tracking.association import AssociatedFrames, Association, OwnDetections
from fusion.tracking.claim_check import ClaimCheck
from fusion.tracking.estimator import AssignedFrames, Estimator, Prediction
from fusion.tracking.exchanged_names import ExchangedNames
from fusion.tracking.identification import RefinedFits
from fusion.tracking.labelings import choose_labelings
from fusion.tracking.motion_models import MotionModels
from fusion.tracking.rays import Marker
from fusion.tracking.result import (
    FilterStep,
    ObservationSummary,
    TrackingResult,
    camera_use,
    markers_message,
    robot_poses,
)
from fusion.tracking.rig_response import RigResponse
from fusion.tracking.robust_update import RobustFit, RobustUpdate
from fusion.tracking.single_view import SingleViewTracker
from fusion.tracking.track_table import TrackTable
from fusion.tracking.trial_updates import with_noise
from fusion.tracking.unlabeled import UnlabeledMarkers, UnlabeledTracker

log = logging.getLogger("fusion")
# Frames that cost as much as their association, which is repeated for each late one: the frames that have arrived are
# associated early when they are so many times as many as the missing ones.
WORTH = 3
PAUSED = "no robot is acquired while the wand is recorded"


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """A frame set after the update of the tracked robots.

    Attributes:
        t_ns: time of the frame set.
        prediction, tracked: see `AssociatedFrames`.
        detections: of all cameras that are not excluded.
        assignments: of the detections, with residuals.
        summary: of the assignments.
        poses: by row of the robot; acquisition does not change these.
    """

    t_ns: int
    prediction: Prediction
    tracked: Mask
    detections: DetectionTable
    assignments: Assignments
    summary: ObservationSummary
    poses: dict[int, RobotPose]


class Tracker:
    """Tracks robots; `track` shows the steps for one frame set.

    The live server calls these steps one by one: it associates frames while it waits for others, and publishes the
    poses of `update` before `finish`, which takes longer.

    Args:
        cameras: the placed cameras, by name; frame sets must not contain frames of others.
        robots: by name, as `load_robots` validated them.
        limits: see `Limits`.
        recalibrates: whether this server corrects the poses of moved cameras, not another zone's.

    Attributes:
        acquires_none: while the wand is recorded: its markers are no robots. Tracked robots continue.
    """

    def __init__(
        self,
        cameras: dict[str, Camera],
        robots: dict[str, Robot],
        limits: Limits | None = None,
        recalibrates: bool = True,
    ) -> None:
        self.cameras = CameraArray(cameras)
        self.limits, self._recalibrates = limits or Limits(), recalibrates
        self.table = TrackTable(robots, self.limits)
        densities = np.array([robot.densities for robot in robots.values()]).reshape(
            -1, 2
        )  # without robots too
        self.estimator = Estimator(self.cameras, densities, self.table.single)
        self.own = OwnDetections(self.cameras, len(robots), self.table.markers)
        self.motion = MotionModels(self.estimator)
        self.robust = RobustUpdate(self.estimator, self.table.markers)
        self.rig_response = RigResponse(self.estimator)
        self.acquisition = Acquisition(self.cameras, self.estimator)
        self.unlabeled = UnlabeledTracker(self.cameras, self.table.markers.radius)
        self.single_view = SingleViewTracker(self.cameras, self.table.markers.radius)
        self.monitors = CameraMonitors(self.cameras, self.table.markers)
        self.claims = ClaimCheck(self.estimator, self.table.markers, self.table.names)
        diameters = np.array([robot.diameter_m for robot in robots.values()])
        self.sizes = SizeCheck(self.table.names, diameters, self.cameras, self.table.markers)
        self.names = ExchangedNames(self.cameras, diameters)
        self.acquires_none = False
        self._reasons: dict[int, str] = {}
        self._displaced: set[str] = set()  # robots whose markers are elsewhere, and were logged

    def admit(self, frame: CalibratedFrame) -> CalibratedFrame | None:
        """A frame in corrected time; None while its camera is withheld, or if that time is in the future."""
        return self.monitors.admit(frame, self._robots_now)

    def _robots_now(self) -> Snapshot | None:
        t_ns = self.table.t_ns
        return None if t_ns is None else Snapshot(t_ns, self.table.states, self.table.located)

    def track(self, frame_set: FrameSet) -> TrackingResult:
        """Track all robots and markers through a complete frame set."""
        predicted = self.predict(frame_set.t_ns)
        associated = self.associate(predicted, frame_set)
        update = self.update(associated, frame_set)
        return self.finish(update)

    def predict(self, t_ns: int, early: AssociatedFrames | None = None) -> AssociatedFrames:
        """Predict all robots to the time of a frame set, and what the cameras see of the tracked ones.

        Args:
            t_ns: time of the frame set.
            early: an earlier return value; returned again if it is for this frame set, robots and camera poses.
        """
        if early is not None and early.association.is_of(t_ns, self.cameras, self.table.markers):
            return early
        received = self.table.apply_received()
        self.rig_response.forget(received)
        self.motion.restart(received)
        dt = np.full(len(self.table.robots), self.table.interval_s(t_ns))
        prediction = self.estimator.predict(self.table.states, dt)
        tracked = self.table.associable(prediction.states)
        scene = self.cameras, self.table.markers, prediction.states, tracked
        association = Association.of(*scene, t_ns)
        return AssociatedFrames(prediction, tracked, association)

    def associate(self, associated: AssociatedFrames, frame_set: FrameSet) -> AssociatedFrames:
        """Assign detections of the frames that are not associated yet to the markers of tracked robots."""
        frames = self._used(frame_set).frames
        return replace(associated, association=associated.association.extended(frames))

    def update(self, associated: AssociatedFrames, frame_set: FrameSet) -> Update:
        """Update the tracked robots with their detections."""
        t_ns = frame_set.t_ns
        detections, all_assigned, labelings = associated.association.collect(self._used(frame_set))
        spread_s = float(np.ptp(detections.exposures.tau)) if len(detections.exposures.tau) else 0.0
        needed = self.table.needed_detections(associated.prediction.states, spread_s)
        scene = self.estimator, self.table.markers, associated.prediction, needed, detections
        all_assigned = choose_labelings(*scene, all_assigned, labelings)
        fitted = self._update_states(associated, needed, detections, all_assigned)
        assignments = fitted.assignments
        self.table.observe(t_ns, assignments)
        tracked = associated.tracked & self.table.alive  # without those that `_update_states` lost
        summary = self._summarize(detections, assignments)
        final = tracked & ~(self.table.single & self._misses_bodies(tracked))
        poses = robot_poses(self.table, self.cameras, t_ns, summary, np.flatnonzero(final).tolist())
        return Update(t_ns, fitted.prediction, tracked, detections, assignments, summary, poses)

    def finish(self, update: Update) -> TrackingResult:
        """Acquire missing robots, track unlabeled markers, and report the frame set."""
        self.sizes.observe(self.table.states, update.detections, update.assignments)
        self.claims.observe(update.prediction, self.table.states, update.detections, update.assignments)
        update, found = self._acquire(update)
        unlabeled = self._track_unlabeled(update, found.markers)
        return self._report(update, unlabeled, found.crowded)

    def check_extrinsics(self, frame_set: FrameSet) -> tuple[ExtrinsicsCorrection | RigRefinement, ...]:
        """Judge the cameras by the robots after a frame set; exclude moved ones and apply recalibrated poses."""
        now = Snapshot(frame_set.t_ns, self.table.states, self.table.located)
        fit = FrameSetFit(self.robust.is_doubtful, self.own.displaced)
        if self.names.check(frame_set):
            for name in self.cameras.names:
                self.monitors.rig.readmit(name)  # what was judged was judged by other images
        frame_set = self.names.without(frame_set)
        corrections = self.monitors.check_extrinsics(frame_set, now, fit, self._recalibrates)
        if self.monitors.rig.is_settled and fit.is_doubtful:
            self.robust.settle()
        if corrections or self.monitors.rig.take_placed():
            self.claims.forget()
        return corrections

    def place(self, name: str, camera: Camera, pinned: bool = False) -> None:
        """Replace the pose of a camera and use its detections; a pinned camera is not excluded again."""
        self.monitors.place(name, camera, pinned)
        self.claims.forget()

    def with_robots(self, robots: dict[str, Robot], renamed: dict[str, str]) -> "Tracker":
        """A tracker of other robots with the same cameras; robots with unchanged markers continue.

        Args:
            robots: the new robots, by name.
            renamed: old name -> new name.
        """
        other = Tracker(self.cameras.as_dict(), robots, self.limits, self._recalibrates)
        other.robust.inherit(self.robust)
        other.acquires_none = self.acquires_none
        same = other.table.inherit(self.table, renamed)
        other.monitors.inherit(self.monitors, same)
        other.names.inherit(self.names)
        other.motion.inherit(self.motion, same)
        other.rig_response.inherit(self.rig_response, same)
        other._claim()
        return other

    def restarted(self) -> "Tracker":
        """A tracker of the same robots that acquires all of them again, after a frame set without a solution. It knows
        the clocks of the cameras and the poses to which they may return."""
        robots = dict(zip(self.table.names, self.table.robots, strict=True))
        other = Tracker(self.cameras.as_dict(), robots, self.limits, self._recalibrates)
        other.acquires_none = self.acquires_none
        other.monitors.clocks.inherit(self.monitors.clocks)
        other.monitors.rig.inherit_poses(self.monitors.rig)
        other.monitors.rig.is_doubted = self.monitors.rig.is_doubted
        other.names.inherit(self.names)
        return other

    def contradictions(self) -> tuple[Contradiction, ...]:
        """The cameras and the robots that contradict what the rig and robots.yaml state of them; each robot is logged
        when it first appears."""
        displaced = tuple(
            Contradiction(
                kind="robot",
                names=(self.table.names[k],),
                error_over_claim=(off_m / PLACE_M) ** 2,
                size_mm=1e3 * off_m,
            )
            for k, off_m in self.monitors.rig.displaced_m.items()
        )
        for contradiction in displaced:
            if contradiction.names[0] not in self._displaced:
                log.warning(describe_contradiction(contradiction))
        self._displaced = {c.names[0] for c in displaced}
        of_cameras = (
            self.names.contradictions()  # which explain the others
            or self.monitors.rig.contradictions()
            or self.claims.contradictions()
        )
        return (*of_cameras, *displaced)

    def judge_cameras_in(self, executor: Executor | None) -> None:
        """Judge the cameras beside the thread that tracks; in it with None."""
        self.monitors.rig.executor = self.names.executor = executor

    def not_acquired(self) -> dict[str, str]:
        """Why the robots that are neither tracked nor coasting were not acquired, by name."""
        missing = np.flatnonzero(self.table.searched & ~self.table.alive).tolist()
        default = PAUSED if self.acquires_none else "not searched for yet"
        return {self.table.names[k]: self._reasons.get(k, default) for k in missing}

    def _used(self, frame_set: FrameSet) -> FrameSet:
        is_known = not any(frame.time_sigma_s for frame in frame_set.frames)
        return self.monitors.used(self.names.without(frame_set), 0.0 if is_known else self.table.speed_m_s)

    def _claim(self) -> None:
        """State the covariances of the robots with the errors of the cameras."""
        table = self.table
        doubts = self.robust.added_px2, self.monitors.rig.is_doubted
        table.claimed = self.rig_response.claimed(table.states, table.markers, *doubts)

    def _misses_bodies(self, tracked: Mask) -> bool:
        """Whether a constellation is missing, whose acquisition can displace a single-marker robot."""
        return bool((~tracked & ~self.table.single).any())

    def _summarize(self, detections: DetectionTable, assignments: Assignments) -> ObservationSummary:
        table = self.table
        return ObservationSummary.of(self.cameras, table.markers, len(table.robots), detections, assignments)

    def _update_states(
        self,
        associated: AssociatedFrames,
        needed: Index,
        detections: DetectionTable,
        assignments: Assignments,
    ) -> RobustFit:
        """Update the states of the robots; its assignments are those that fit, with residuals."""
        prediction, tracked = associated.prediction, associated.tracked
        observed = MatchedObservations.of(assignments, detections, self.table.markers)
        observations = self.estimator.prepared(prediction.states, observed)
        given = AssignedFrames(prediction, tracked, detections, assignments, observations)
        own = self.own.are_own(given, self.robust.noise_px2)
        given = given.select(own)
        if self.robust.is_doubtful or self.own.displaced or self.monitors.rig.contradicting:
            self.motion.restart()
        else:
            given = replace(given, prediction=self.motion.narrowed(prediction, given.observations))
            if not detections.exposures.are_exact:  # where velocities are better known, times make less noise
                observations = self.estimator.prepared(given.prediction.states, observed.select(own))
                given = replace(given, observations=observations)
        fitted = self.robust.update(given, needed, self.motion.is_sudden)
        refuted = self.robust.refuted(fitted, tracked & self.table.searched)
        if refuted.any():
            fitted = fitted.without(refuted)
            self.table.lose(np.flatnonzero(refuted))
        self.table.states = fitted.states
        self.rig_response.update(fitted)
        self._claim()
        return fitted

    def _acquire(self, update: Update) -> tuple[Update, Acquired]:
        """Acquire missing robots; returns the update with their assignments."""
        missing = np.flatnonzero(~update.tracked & self.table.searched & (not self.acquires_none))
        histories = partial(self.unlabeled.histories, update.t_ns)
        found = self.acquisition.acquire(
            self.table, missing, update.detections, update.assignments, histories
        )
        self._reasons = found.reasons
        self._start(found.fits)
        self.table.lose(found.displaced)
        if len(found.assignments) != len(update.assignments):
            self.table.observe(update.t_ns, found.assignments)
        if not len(missing):
            return update, found
        summary = self._summarize(update.detections, found.assignments)
        return replace(update, assignments=found.assignments, summary=summary), found

    def _start(self, found: tuple[RefinedFits, ...]) -> None:
        """Track the robots that were acquired."""
        if not found:
            return
        if not self.robust.is_confirmed:
            motion_px2 = [
                self.estimator.select(fits.robot).motion_px2(fits.states, fits.observations)[
                    self.table.are_elsewhere(fits.robot, fits.states)
                ]
                for fits in found
            ]
            self.robust.start(np.concatenate(motion_px2), int(self.table.located.sum()))
        added_px2 = self.robust.added_px2
        for fits in found:
            start = with_noise(self.estimator, fits, added_px2)
            self.table.adopt(start.robot, start.states)
            self.motion.restart(start.robot)
            self.rig_response.restart(self.table.states, start, added_px2)
        self._claim()

    def _track_unlabeled(self, update: Update, markers: list[Marker]) -> UnlabeledMarkers:
        """Track the remaining markers, and those that only one camera sees."""
        seen = self.unlabeled.track(update.t_ns, update.detections, markers)
        used = np.concatenate([update.assignments.detection, seen.detections])
        rows = self.single_view.confirm(update.t_ns, update.detections, used)
        self.acquisition.search.is_due = len(rows) > 0
        if not len(rows):
            return seen
        positions, covariances = self.table.alive_markers()
        known = np.concatenate([positions, seen.position]), np.concatenate([covariances, seen.covariance])
        return seen.joined(self.single_view.locate(update.detections, rows, known))

    def _report(self, update: Update, unlabeled: UnlabeledMarkers, crowded: Index) -> TrackingResult:
        """The result of the frame set; the poses of the update stay as they were published."""
        table, summary, t_ns = self.table, update.summary, update.t_ns
        rest = [k for k in np.flatnonzero(table.owned).tolist() if k not in update.poses]
        poses = update.poses | robot_poses(table, self.cameras, t_ns, summary, rest)
        marker_cameras = summary.marker_cameras & table.owned[table.markers.robot][:, None]
        return TrackingResult(
            t_ns,
            tuple(poses[k] for k in sorted(poses)),
            markers_message(table, self.cameras, t_ns, marker_cameras, unlabeled, update.detections),
            camera_use(self.cameras, update.detections, update.assignments, unlabeled.markers),
            update.assignments,
            summary,
            FilterStep(
                table.states,
                update.prediction,
                update.tracked & table.alive,
                table.claimed - table.states.P + self.rig_response.counted,
            ),
            tuple(self.cameras.names[k] for k in crowded.tolist()),
        )
