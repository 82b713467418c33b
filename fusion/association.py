# SPDX-License-Identifier: BSD-3-Clause
"""Which detection is of which marker, while robots are tracked.

Each marker is predicted into each frame at the frame's own time; within a gate of its covariance and apparent size,
detections are assigned globally, frame by frame: no detection is of two markers. The cost of a pair is its negative
log-likelihood (Bar-Shalom et al. 2001, section 6.4), so that a vague prediction does not take what an exact one fits:
`native/candidates.cpp` finds the pairs and their costs, `native/assignment.cpp` chooses among them.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fusion import _core
from fusion.instants import Frame, Instant
from fusion.optics import Optics
from fusion.sightings import Catalogue, Matches, Sightings
from fusion.state import States

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class Association:
    """An instant's detections matched to robots, as many frames at a time as there are.

    Args:
        optics: the cameras.
        catalogue: the robots' markers.
        states: the robots as predicted at `t_ns`.
        active: (N,) those whose markers are looked for.
        t_ns: the instant.
        floor_px: see `Sightings.of`.
    """

    def __init__(
        self,
        optics: Optics,
        catalogue: Catalogue,
        states: States,
        active: NDArray[np.bool_],
        t_ns: int,
        floor_px: float,
    ) -> None:
        self._optics, self._catalogue, self._states = optics, catalogue, states
        self._markers = np.flatnonzero(active[catalogue.robot])
        discs = catalogue.robot[self._markers], catalogue.marker.take(self._markers, 1)
        self._expected = _core.ExpectedMarkers(states.R, states.P, *discs, catalogue.radius[self._markers])
        self._t_ns, self._floor_px = t_ns, floor_px
        self._done: dict[int, tuple[Frame, Matches]] = {}  # by the frame's id(), each with its rows from 0

    def missing(self, frames: Sequence[Frame]) -> tuple[Frame, ...]:
        """Those of the frames that are not matched yet."""
        return tuple(frame for frame in frames if id(frame) not in self._done)

    def add(self, frames: Sequence[Frame]) -> None:
        """Match those of the frames that are not matched yet, all at once."""
        new = self.missing(frames)
        if new:
            sightings = Sightings.of(Instant(self._t_ns, new), self._optics, self._floor_px)
            parts = self._match(sightings).split([len(frame.roundels) for frame in new])
            self._done |= {id(frame): (frame, part) for frame, part in zip(new, parts, strict=True)}

    def whole(self, instant: Instant) -> tuple[Sightings, Matches]:
        """All detections of the instant, and what they are matched to."""
        self.add(instant.frames)
        sightings = Sightings.of(instant, self._optics, self._floor_px)
        counts = [len(frame.roundels) for frame in instant.frames]
        return sightings, Matches.stack([self._done[id(frame)][1] for frame in instant.frames], counts)

    def _match(self, sightings: Sightings) -> Matches:
        exposures = sightings.exposures
        pairs, cost = self._expected.candidates(
            self._optics.pose(self._states, exposures),
            sightings.frame,
            sightings.xy,
            sightings.scale,
            sightings.cov,
            sightings.axes_px[0],
            self._optics.focal[exposures.camera],
        )
        chosen = _core.assign(pairs, cost, sightings.frame)
        marker, sighting = pairs[:, chosen]
        return Matches.of(sighting, self._markers[marker])
