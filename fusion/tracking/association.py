# SPDX-License-Identifier: BSD-3-Clause
"""Associates detections with the markers of tracked robots.

Each marker is predicted into each frame at the capture time of the frame. Within a gate of its covariance and apparent
size, detections are assigned frame by frame: each detection to one marker at most, at the lowest total cost. The cost
of a pair is its negative log-likelihood (Bar-Shalom et al. 2001, section 6.4), so a vague prediction does not take a
detection that fits an exact one. `native/candidates.cpp` finds the pairs and their costs.

`OwnDetections` then tests whether what was assigned to a robot that was differently seen before is its own.

A covered robot has detections of others in its gates. Its pose adapts to one or two of them exactly, so that their
residuals show nothing, and the covariance claims what its own markers would determine. The score of detections is the
log-likelihood ratio of both cases (track score: Blackman and Popoli 1999, section 6.2), with innovations nu, the
prediction P, and the density of all roundels in the image:

    log N(nu; 0, H P H^T + R) - n log(density)

A robot of which much is missing needs more than what its missing markers cost: log(1 - P_D) each, and at most the
probability that something hides them from a camera. A camera that did not see the robot needs more than the
probability that it does now. Where a camera shows the smaller part of what it usually shows of a robot, or at first of
the markers that face it, and in clutter, where other roundels are expected in gates, the nearest detection may be
another's: there its view of the robot is judged given what the other cameras see. A camera that alone shows most of
what it usually sees elsewhere, all by one turn, was moved: what it still shows near the predictions is not theirs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from camera_node.foundation.arrays import Array, Index, Mask
from fusion import _core
from fusion.model.expected_views import TURNED, ExpectedViews, match_moved
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.observations import (
    Assignments,
    CameraArray,
    DetectionTable,
    MarkerTable,
    detection_density,
)
from fusion.model.states import POSITION, VELOCITY, States
from fusion.tracking.estimator import AssignedFrames, Prediction
from fusion.tracking.labelings import MISSED, Labelings, find_labelings
from fusion.tracking.rays import GATE


@dataclass(frozen=True, slots=True, eq=False)
class _AssignedFrames:
    """Frames that were assigned together: for each detection its row of the marker table or -1, by frame; and the other
    labelings of robots that are hardly less probable."""

    frames: tuple[CalibratedFrame, ...]
    marker: Index
    labelings: Labelings

    def by_frame(self) -> Iterator[tuple[int, Index]]:
        """Of each frame its identity, and the rows of the marker table of its detections."""
        last = 0
        for frame in self.frames:
            first, last = last, last + frame.columns.shape[1]
            yield id(frame), self.marker[first:last]


@dataclass(frozen=True, slots=True, eq=False)
class Association:
    """The assignments of some frames of one frame set; a value, which `extended` leaves unchanged.

    Attributes:
        cameras: cameras of the rig; `revision` is theirs at the prediction.
        marker_table: markers of all robots.
        states: robots predicted at `t_ns`.
        markers: (M,) rows of the marker table: the markers of the tracked robots.
        expected: the same with the covariances of their positions.
        t_ns: time of the frame set.
        parts: the frames assigned so far.
    """

    cameras: CameraArray
    revision: int
    marker_table: MarkerTable
    states: States
    markers: Index
    expected: _core.ExpectedMarkers
    t_ns: int
    parts: tuple[_AssignedFrames, ...] = ()

    @classmethod
    def of(
        cls,
        cameras: CameraArray,
        marker_table: MarkerTable,
        states: States,
        tracked: Mask,
        t_ns: int,
    ) -> "Association":
        """No assignments yet.

        Args:
            cameras: cameras of the rig.
            marker_table: markers of all robots.
            states: robots predicted at `t_ns`.
            tracked: (N,) robots whose markers are expected.
            t_ns: time of the frame set.
        """
        rows = np.flatnonzero(tracked[marker_table.robot])
        expected = marker_table.expected(rows, states)
        return cls(cameras, cameras.revision, marker_table, states, rows, expected, t_ns)

    @property
    def n_frames(self) -> int:
        """How many frames are assigned."""
        return sum(len(part.frames) for part in self.parts)

    def is_of(self, t_ns: int, cameras: CameraArray, marker_table: MarkerTable) -> bool:
        """Whether this is of the frame set at `t_ns`, of these markers, and of the present poses of the cameras."""
        return self.t_ns == t_ns and self.marker_table is marker_table and self.revision == cameras.revision

    def pending(self, frames: Sequence[CalibratedFrame]) -> tuple[CalibratedFrame, ...]:
        """The frames that are not assigned yet."""
        assigned = {id(frame) for part in self.parts for frame in part.frames}
        return tuple(frame for frame in frames if id(frame) not in assigned)

    def extended(self, frames: Sequence[CalibratedFrame]) -> "Association":
        """With the pending frames assigned."""
        new = self.pending(frames)
        if not new:
            return self
        detections = DetectionTable.of(FrameSet(self.t_ns, new), self.cameras)
        part = _AssignedFrames(new, *self._assign(detections))
        return replace(self, parts=(*self.parts, part))

    def collect(self, frame_set: FrameSet) -> tuple[DetectionTable, Assignments, Labelings]:
        """All detections of a frame set whose frames are assigned, its assignments in the order of the detections, and
        other labelings that are hardly less probable."""
        detections = DetectionTable.of(frame_set, self.cameras)
        assigned = dict(chain.from_iterable(part.by_frame() for part in self.parts))
        of_none = np.empty(0, np.intp)
        marker_of = np.concatenate([of_none, *(assigned[id(frame)] for frame in frame_set.frames)])
        detection = np.flatnonzero(marker_of >= 0)
        return detections, Assignments.of(detection, marker_of[detection]), self._labelings(frame_set.frames)

    def _labelings(self, frames: Sequence[CalibratedFrame]) -> Labelings:
        """Those of all parts, with the rows of these frames and of their detections."""
        parts, found = [part for part in self.parts if len(part.labelings)], list[Labelings]()
        if not parts:
            return Labelings.none()
        number, first = {id(frame): k for k, frame in enumerate(frames)}, np.append(_first_rows(frames), 0)
        for part in parts:
            at = np.array(
                [number.get(id(frame), -1) for frame in part.frames], np.intp
            )  # -1: not one of these
            others = part.labelings.select(at[part.labelings.frame] >= 0)
            rows = others.detection + (first[at] - _first_rows(part.frames))[others.frame[others.number]]
            found.append(replace(others, frame=at[others.frame], detection=rows))
        return Labelings.none().joined(*found)

    def _assign(self, detections: DetectionTable) -> tuple[Index, Labelings]:
        """(N,) the row of the marker table of each detection, -1 for none, and other labelings."""
        exposures = detections.exposures
        poses = self.cameras.frame_poses(self.states, exposures)
        focal = self.cameras.focal[exposures.camera]
        pairs, cost = self.expected.candidates(poses, detections.native, focal)
        chosen = _core.assign(pairs, cost, detections.frame)
        pairs[0] = self.markers[pairs[0]]
        robot = self.marker_table.robot[pairs[0]]
        labelings = find_labelings(self.cameras, detections, pairs, cost, robot, chosen)
        marker = np.full(len(detections), -1)
        marker[pairs[1, chosen]] = pairs[0, chosen]
        return marker, labelings


@dataclass(frozen=True, slots=True, eq=False)
class AssociatedFrames:
    """A frame set whose frames may be associated before all of them have arrived.

    Attributes:
        prediction: all robots at the time of the frame set.
        tracked: (R,) robots whose detections are associated; the others are acquired.
        association: the assignments so far.
    """

    prediction: Prediction
    tracked: Mask
    association: Association


def _first_rows(frames: Sequence[CalibratedFrame]) -> Index:
    """The row of each frame's first detection in a detection table."""
    return np.cumsum([0, *(frame.columns.shape[1] for frame in frames)])[:-1]


LEARNED = 8  # frames of a camera that define the usual number of detections of a robot
# Of a robot or its view in a camera from one frame to the next: hidden, or visible again.
CHANGED = np.log(0.02)
CLUTTERED = np.exp(CHANGED)  # other roundels expected in a gate: as probable there as what is judged anyway


class OwnDetections:
    """The usual number of detections of each robot in each camera.

    Args:
        cameras: cameras of the rig.
        n_robots: number of robots.
        markers: of all robots.

    Attributes:
        displaced: cameras of the last frame set that showed most markers elsewhere, and in how many in a row of those
            with their frames.
    """

    def __init__(self, cameras: CameraArray, n_robots: int, markers: MarkerTable) -> None:
        self._cameras, self._markers = cameras, markers
        self._shape = (n_robots, len(cameras.names))
        self._usual, self._learned = np.zeros(self._shape), np.zeros(self._shape, np.intp)
        self._unseen = np.zeros(self._shape, bool)  # in the last frame of the camera
        self._elsewhere = np.zeros(len(cameras.names), np.intp)  # frame sets in a row, of each camera
        self.displaced = dict[int, int]()

    def are_own(self, given: AssignedFrames, noise_px2: float) -> Mask:
        """(N,) assignments of a frame set that are more probable than detections of something else.

        Args:
            given: the frame set.
            noise_px2: variance that detections usually have beside their own noise: of a view that shows little of a
                robot, the rest may be outside the gates by errors of the camera.
        """
        robot, camera = given.observations.body, given.observations.camera
        view = robot * self._shape[1] + camera
        frames = np.bincount(given.detections.exposures.camera, minlength=self._shape[1])
        count = self._count(view)
        missing = np.maximum(self._usual * frames - count, 0)
        displaced = self._find_displaced(given, count, missing)
        count[:, displaced] = missing[:, displaced] = 0
        self._elsewhere = np.where(displaced, self._elsewhere + 1, np.where(frames > 0, 0, self._elsewhere))
        self.displaced = {k: int(self._elsewhere[k]) for k in np.flatnonzero(displaced).tolist()}
        frames = np.where(displaced, 0, frames)
        cost = np.maximum(missing * MISSED, CHANGED).sum(1)
        fallen = (count.sum(1) > 0) & (missing.sum(1) > count.sum(1))
        present = (count > 0) & ~fallen[:, None]
        unseen = present & self._unseen
        cluttered = present & ~unseen & self._cluttered(given)
        partial = present & ~unseen & ~cluttered & ((missing > count) | self._shows_few(given, count))
        doubtful = unseen | cluttered | partial
        own = ~(fallen[robot] | doubtful.ravel()[view] | displaced[camera])
        prior = cost[fallen] - CHANGED
        own = self._accepted(given, own, (fallen, prior), (cluttered, partial, unseen), noise_px2)
        self._learn(self._count(view[own]), frames, given.tracked)
        return own

    def _shows_few(self, given: AssignedFrames, count: Index) -> Mask:
        """(R, C) first views of robots that show the smaller part of the markers that face the camera: nothing is usual
        yet, and what is not theirs would become it."""
        found, exposures = np.zeros(self._shape, bool), given.detections.exposures
        first = (self._learned == 0) & (count > 0)
        for k in np.flatnonzero(first.any(0)).tolist():
            tau = float(exposures.tau[exposures.camera == k][-1])
            markers = self._markers, np.flatnonzero(first[self._markers.robot, k])
            expected = ExpectedViews.of(
                self._cameras, self._cameras.names[k], given.prediction.states, tau, markers
            )
            facing = np.bincount(self._markers.robot[expected.rows], minlength=self._shape[0])
            found[:, k] = first[:, k] & (facing > 2 * count[:, k])
        return found

    def _cluttered(self, given: AssignedFrames) -> Mask:
        """(R, C) views in which other roundels are expected in the gate of a marker, as wide as that of its robot."""
        found, seen, states = np.zeros(self._shape, bool), given.detections, given.prediction.states
        is_other = np.ones(len(seen), bool)
        is_other[given.assignments.detection] = False
        others = seen.frame[is_other]
        if not len(others):
            return found
        density = detection_density(self._cameras, seen, others)
        gate_px2 = np.pi * GATE * self._variance_px2(states, seen)
        robot, frame = np.nonzero(gate_px2 * density > CLUTTERED)
        found[robot, seen.exposures.camera[frame]] = True
        return found

    def _variance_px2(self, states: States, seen: DetectionTable) -> Array:
        """(R, F) of a coordinate of the predicted images of robots in each frame, px^2, by their positions."""
        camera, tau = seen.exposures.camera, seen.exposures.tau
        of_p, of_both, of_v = (
            np.einsum("nii->n", states.P[:, a, b])[:, None]
            for a, b in ((POSITION, POSITION), (POSITION, VELOCITY), (VELOCITY, VELOCITY))
        )
        variance = (of_p + 2 * tau * of_both + tau**2 * of_v) / 3
        off = states.p[:, None] - self._cameras.centres[camera]
        squared_m2 = np.einsum("rfi,rfi->rf", off, off)
        return np.asarray(self._cameras.focal[camera] ** 2 * variance / squared_m2, float)

    def _accepted(
        self,
        given: AssignedFrames,
        certain: Mask,
        fallen: tuple[Mask, Array],
        views: tuple[Mask, Mask, Mask],
        noise_px2: float,
    ) -> Mask:
        """(N,) the certain assignments, and those that are more probable as those of their robots.

        Args:
            given: N assignments of a frame set.
            certain: (N,) assignments that are not to be judged.
            fallen: (R,) robots of which much is missing, and the logarithm of how probable the rest of each is.
            views: (R, C) those in clutter, those that show few, and those that were not seen before.
            noise_px2: see `are_own`; of the views that show few.
        """
        robots, asked = np.flatnonzero(fallen[0]), [np.nonzero(of_kind) for of_kind in views]
        of_robot = np.concatenate([robots, *(robot for robot, _ in asked)])
        if not len(of_robot):
            return certain
        of_camera = np.concatenate([np.full(len(robots), -1), *(camera for _, camera in asked)])
        # What a camera did not see before is judged given all that others see.
        turn = np.repeat([0, 0, 1, 2], [len(robots), *(len(robot) for robot, _ in asked)])
        prior, added_px2 = np.where(turn == 2, CHANGED, 0.0), np.where(turn == 1, noise_px2, 0.0)
        prior[: len(robots)] = fallen[1]
        observed = given.observations
        seen = observed.matched.detections
        density = detection_density(self._cameras, given.detections, given.detections.frame)
        log_density = np.log(density[seen.frame])
        evidence = observed.centres, seen.cov, log_density, observed.body, seen.camera, certain
        doubts = of_robot, of_camera, turn, prior, added_px2
        return _core.are_own(*evidence, given.prediction.information, *doubts)

    def _find_displaced(self, given: AssignedFrames, count: Index, missing: Array) -> Mask:
        """(C,) the cameras in which most markers that they usually show are elsewhere, all by one turn, while another
        camera shows these robots where they are predicted.

        Args:
            given: a frame set.
            count, missing: (R, C) markers that were assigned in each camera, and those that usually are, and were not.
        """
        found, lost = np.zeros(self._shape[1], bool), missing.sum(0) > count.sum(0)
        for k in np.flatnonzero(lost).tolist():
            robots = given.tracked & (self._usual[:, k] > 0)
            of_others = np.ix_(robots, ~lost)
            # Whether another camera shows that the robots are where they are predicted.
            if not (count[of_others].sum(0) > missing[of_others].sum(0)).any():
                continue
            rows = np.flatnonzero(robots[self._markers.robot])
            elsewhere = self._shown_elsewhere(given, k, rows)
            found[k] = elsewhere > max((count + missing)[:, k].sum() / 2, count[:, k].sum())
        return found

    def _shown_elsewhere(self, given: AssignedFrames, camera: int, rows: Index) -> int:
        """How many of the markers `rows` the frames of a camera show where one turn of it explains, outside the gates
        of their predictions: fewer are assigned within these where a frame has several labelings."""
        name, seen = self._cameras.names[camera], given.detections
        frames = np.flatnonzero(seen.exposures.camera == camera)
        scene = self._cameras, name, given.prediction.states
        expected = [ExpectedViews.of(*scene, seen.exposures.tau[k], (self._markers, rows)) for k in frames]
        detected = [seen.uv[:, seen.frame == k].T for k in frames]
        pairs = match_moved(self._cameras[name], expected, detected, TURNED)[1]
        gate_px2 = GATE * (
            self._variance_px2(given.prediction.states, seen) + self._cameras.error_px[camera] ** 2
        )
        n = 0
        for k, views, uv, (shown, there) in zip(frames, expected, detected, pairs, strict=True):
            off_px2 = np.sum((uv[there] - views.uv[shown]) ** 2, axis=1)
            n += int(np.sum(off_px2 > gate_px2[self._markers.robot[views.rows[shown]], k]))
        return n

    def _count(self, view: Index) -> Index:
        """(R, C) numbers of assignments."""
        return np.bincount(view, minlength=self._shape[0] * self._shape[1]).reshape(self._shape)

    def _learn(self, count: Index, frames: Index, expected: Mask) -> None:
        """Adapt the usual numbers of expected robots in the cameras that sent frames; forget those of others."""
        known = expected[:, None] & (frames > 0)
        for column in (self._usual, self._learned, self._unseen):
            column[~expected] = 0
        self._unseen = np.where(known, count == 0, self._unseen)
        self._learned += known
        rate = known / np.maximum(np.minimum(self._learned, LEARNED), 1)
        self._usual += rate * (count / np.maximum(frames, 1) - self._usual)
