# SPDX-License-Identifier: BSD-3-Clause
"""After an instant was told: frames are compared with what robots seen by two other cameras should look like.

A camera that stands is looked at in turn, just often enough that a move is named within a second; one that is set
aside, in every instant.
"""

from typing import Protocol

import numpy as np

from calib.rig.camera import Camera
from camera_node.arrays import Array, Index
from fusion.model.camera_array import CameraArray, Exposures
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.observations import Assignments, DetectionTable, MarkerTable
from fusion.model.states import States
from fusion.monitoring.extrinsics_monitor import Expected, ExtrinsicsMonitor
from fusion.protocol.messages import TrackingState
from fusion.protocol.shards import Shard
from fusion.tracking.result import Move

WATCHED = 20  # markers, at the most, that are compared with their images in one look
LOOK_NS = 250_000_000  # between looks at a camera of so many markers; of fewer, more often
WATCH_FACING, WATCH_MARGIN_PX = 0.35, 30.0  # what a camera surely sees


class Inspected(Protocol):
    """What an inspection needs of a tracker."""

    optics: CameraArray
    catalogue: MarkerTable
    states: States
    status: list[TrackingState | None]
    shard: Shard
    watch: ExtrinsicsMonitor

    def place(self, name: str, camera: Camera) -> None: ...


class Inspection:
    """Finds cameras that were moved, and places them anew."""

    def __init__(self, tracker: Inspected) -> None:
        self.tracker = tracker
        self._watched = 0
        self._turns: dict[str, int] = {}  # of each camera, the last in which it was looked at

    def inspect(self, instant: FrameSet, sightings: DetectionTable, matches: Assignments) -> tuple[Move, ...]:
        """Place cameras anew that were moved; says which were, and where they stand."""
        tracker = self.tracker
        seen = np.zeros((len(tracker.status), len(tracker.optics.names)), bool)
        seen[tracker.catalogue.robot[matches.disc], sightings.camera[matches.sighting]] = True
        steady = np.array([status == "tracked" for status in tracker.status])
        n_steady = int(steady[tracker.catalogue.robot].sum())
        for frame in (frame for frame in instant.frames if self._is_due(frame, n_steady)):
            camera = tracker.optics.index[frame.camera]
            others = seen.sum(1) - seen[:, camera]
            markers = np.flatnonzero((steady & (others >= 2))[tracker.catalogue.robot])
            markers = np.roll(markers, -self._watched)[:WATCHED]
            self._watched += WATCHED + 1
            points = self._expect(frame, camera, (frame.t_ns - instant.t_ns) * 1e-9, markers)
            if points.shape[1]:
                tracker.watch.note(tracker.optics.cameras[camera], Expected(frame, points))
        return self._heal()

    def _is_due(self, frame: CalibratedFrame, n_markers: int) -> bool:
        """Whether it is the camera's turn, which comes at other times than the other cameras'."""
        optics = self.tracker.optics
        interval_ns = LOOK_NS * min(n_markers, WATCHED) / WATCHED
        if frame.camera in self.tracker.watch.bumped or not interval_ns:
            return True
        turn = int(frame.t_ns / interval_ns + optics.index[frame.camera] / len(optics.names))
        was, self._turns[frame.camera] = self._turns.get(frame.camera), turn
        return turn != was

    def _expect(self, frame: CalibratedFrame, camera: int, tau: float, markers: Index) -> Array:
        """(3, N) points in the world whose projections are the outlines' centres that the frame should show."""
        exposures = Exposures(np.array([camera]), np.array([tau]))
        optics, lens = self.tracker.optics, self.tracker.optics.cameras[camera]
        discs = self.tracker.catalogue.discs(markers, np.zeros(len(markers), np.intp))
        views = optics.view(optics.pose(self.tracker.states, exposures), discs)
        points = optics.R_cam_world[camera].T @ views.q + optics.centres[camera][:, None]
        uv, size = lens.project(views.q.T), np.array([lens.width, lens.height])
        inside = ((uv > WATCH_MARGIN_PX) & (uv < size - WATCH_MARGIN_PX)).all(1)
        return points[:, inside & (views.facing > WATCH_FACING)]

    def _heal(self) -> tuple[Move, ...]:
        tracker, moves = self.tracker, []
        if (name := tracker.watch.find_bumped()) is not None:
            moves.append(Move(name, None))
        for name in sorted(tracker.watch.bumped) if tracker.shard.leads else ():
            camera = tracker.watch.heal(name, tracker.optics.cameras[tracker.optics.index[name]])
            if camera is not None:
                tracker.place(name, camera)
                moves.append(Move(name, camera))
        return tuple(moves)
