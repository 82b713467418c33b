# SPDX-License-Identifier: BSD-3-Clause
"""After an instant was told: frames are compared with what robots seen by two other cameras should look like."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib.camera import Camera
from fusion.instants import Frame, Instant
from fusion.messages import State
from fusion.optics import Exposures, Optics
from fusion.report import Move
from fusion.shards import Shard
from fusion.sightings import Catalogue, Matches, Sightings
from fusion.state import States
from fusion.watch import Expected, Watch

Array = NDArray[np.float64]
WATCHED = 40  # markers that are compared with their images in one instant, about
WATCH_FACING, WATCH_MARGIN_PX = 0.35, 30.0  # what a camera surely sees


class Inspected(Protocol):
    """What an inspection needs of a tracker."""

    optics: Optics
    catalogue: Catalogue
    states: States
    status: list[State | None]
    shard: Shard
    watch: Watch

    def place(self, name: str, camera: Camera) -> None: ...


class Inspection:
    """Finds cameras that were moved, and places them anew."""

    def __init__(self, tracker: Inspected) -> None:
        self.tracker = tracker
        self._watched = 0

    def inspect(self, instant: Instant, sightings: Sightings, matches: Matches) -> tuple[Move, ...]:
        """Place cameras anew that were moved; says which were, and where they stand."""
        tracker = self.tracker
        seen = np.zeros((len(tracker.status), len(tracker.optics.names)), bool)
        seen[tracker.catalogue.robot[matches.disc], sightings.camera[matches.sighting]] = True
        steady = np.array([status == "tracked" for status in tracker.status])
        for frame in self._turn(instant.frames):
            camera = tracker.optics.index[frame.camera]
            others = seen.sum(1) - seen[:, camera]
            markers = np.flatnonzero((steady & (others >= 2))[tracker.catalogue.robot])
            markers = np.roll(markers, -self._watched)[:WATCHED]
            points = self._expect(frame, camera, (frame.t_ns - instant.t_ns) * 1e-9, markers)
            if points.shape[1]:
                tracker.watch.note(tracker.optics.cameras[camera], Expected(frame, points))
        return self._heal()

    def _turn(self, frames: tuple[Frame, ...]) -> tuple[Frame, ...]:
        """Some of the frames, others in the next instant, so that watching costs the same in a large arena."""
        n = max(1, WATCHED // max(len(self.tracker.catalogue.robot), 1))
        first = self._watched % max(len(frames), 1)
        self._watched += n
        return (frames + frames)[first : first + min(n, len(frames))]

    def _expect(self, frame: Frame, camera: int, tau: float, markers: NDArray[np.intp]) -> Array:
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
