# SPDX-License-Identifier: BSD-3-Clause
"""The tables that fusion works on: an instant's detections, the robots' markers, and which is of which."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera_node.arrays import Array, Index
from fusion.model.camera_array import CameraArray, Discs, Exposures, taken
from fusion.model.frames import FrameSet
from fusion.model.robots import Robot


@dataclass(frozen=True, slots=True, eq=False)
class DetectionTable:
    """All N detections of an instant, columns last.

    Attributes:
        exposures: the instant's frames.
        frame: (N,) row in them.
        uv, cov: (2, N) raw pixels and (2, 2, N) their noise.
        axes_px, angle_rad: (2, N) and (N,) of the outline, NaN where unknown.
        xy: (2, N) undistorted; NaN where the lens has no inverse.
        scale: (2, 2, N) derivative of raw pixels by xy.
    """

    exposures: Exposures
    frame: Index
    uv: Array
    cov: Array
    axes_px: Array
    angle_rad: Array
    xy: Array
    scale: Array

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def camera(self) -> Index:
        """(N,) index of the camera."""
        return self.exposures.camera[self.frame]

    @property
    def tau(self) -> Array:
        """(N,) capture time less the instant's, seconds."""
        return self.exposures.tau[self.frame]

    def select(self, rows: NDArray) -> "DetectionTable":
        """The columns that a mask or an index array names."""
        of_each = self.frame, self.uv, self.cov, self.axes_px, self.angle_rad, self.xy, self.scale
        return DetectionTable(self.exposures, *taken(rows, *of_each))

    @classmethod
    def of(cls, instant: FrameSet, optics: CameraArray, floor_px: float) -> "DetectionTable":
        """The detections of an instant; `floor_px` is added to what detectors say of their noise."""
        frames = instant.frames
        exposures = Exposures(
            np.array([optics.index[frame.camera] for frame in frames], np.intp),
            np.array([(frame.t_ns - instant.t_ns) * 1e-9 for frame in frames]),
        )
        row = np.repeat(np.arange(len(frames)), [len(frame.roundels) for frame in frames])
        cov = _joined([f.roundels.cov.transpose(1, 2, 0) for f in frames], (2, 2, 0))
        cov[[0, 1], [0, 1]] += floor_px**2
        return cls(
            exposures,
            row,
            _joined([f.roundels.uv.T for f in frames], (2, 0)),
            cov,
            _joined([f.roundels.axes_px.T for f in frames], (2, 0)),
            _joined([f.roundels.angle_rad for f in frames], (0,)),
            _joined([f.xy for f in frames], (2, 0)),
            _joined([f.scale for f in frames], (2, 2, 0)),
        )


def _joined(columns: list[Array], empty: tuple[int, ...]) -> Array:
    return np.concatenate([np.zeros(empty), *columns], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class MarkerTable:
    """All K markers of all robots: robot (K,), number in the robot (K,), centre (3, K), radius (K,).

    `first` (R + 1,): robot r has the rows first[r] to first[r + 1].
    """

    robot: Index
    number: Index
    marker: Array
    radius: Array
    first: Index

    @classmethod
    def of(cls, robots: list[Robot]) -> "MarkerTable":
        counts = [len(robot.markers) for robot in robots]
        return cls(
            np.repeat(np.arange(len(robots)), counts),
            np.concatenate([np.empty(0, np.intp), *(np.arange(n) for n in counts)]).astype(np.intp),
            np.concatenate([np.empty((3, 0)), *(robot.points.T for robot in robots)], axis=1),
            np.repeat([robot.diameter_m / 2 for robot in robots], counts),
            np.concatenate([[0], np.cumsum(counts)]).astype(np.intp),
        )

    def discs(self, rows: Index, frame: Index) -> Discs:
        """Markers `rows`, each in a frame."""
        return Discs(frame, self.robot[rows], rows, self.marker.take(rows, 1), self.radius[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Assignments:
    """Rows of the sightings, the rows of the catalogue that they are of, and what remains of each, px^2."""

    sighting: Index
    disc: Index
    squared_px: Array

    @classmethod
    def of(cls, sighting: Index, disc: Index) -> "Assignments":
        """Matches before any estimate."""
        return cls(sighting, disc, np.full(len(disc), np.nan))

    @classmethod
    def none(cls) -> "Assignments":
        """No match."""
        return cls.of(np.empty(0, np.intp), np.empty(0, np.intp))

    def __len__(self) -> int:
        return len(self.sighting)

    def remaining(self, error_px: Array) -> "Assignments":
        """The same, with what remains of each (2, N)."""
        return Assignments(self.sighting, self.disc, np.sum(error_px**2, 0))

    def select(self, rows: NDArray) -> "Assignments":
        """The rows that a mask or an index array names."""
        return Assignments(self.sighting[rows], self.disc[rows], self.squared_px[rows])

    def joined(self, other: "Assignments") -> "Assignments":
        """Both."""
        return Assignments(*(np.concatenate([getattr(self, k), getattr(other, k)]) for k in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class MatchedObservations:
    """N detections and the discs they are of. `whiten` (2, 2, N) takes errors in xy to a standard deviation of 1."""

    discs: Discs
    seen: DetectionTable
    whiten: Array

    @classmethod
    def of(
        cls, matches: Assignments, sightings: DetectionTable, catalogue: MarkerTable
    ) -> "MatchedObservations":
        """The matched detections."""
        return cls.seeing(
            sightings.select(matches.sighting),
            catalogue.discs(matches.disc, sightings.frame[matches.sighting]),
        )

    @classmethod
    def seeing(cls, seen: DetectionTable, discs: Discs) -> "MatchedObservations":
        """Detections of known discs."""
        return cls(discs, seen, _whiten(seen))

    def __len__(self) -> int:
        return len(self.discs)

    def select(self, rows: NDArray) -> "MatchedObservations":
        """The columns that a mask or an index array names."""
        rows = np.flatnonzero(rows) if rows.dtype == bool else rows
        return MatchedObservations(self.discs.select(rows), self.seen.select(rows), *taken(rows, self.whiten))


def _whiten(seen: DetectionTable) -> Array:
    """L^-1 scale, where L L^T is the detection's covariance."""
    a = np.sqrt(seen.cov[0, 0])
    b = seen.cov[0, 1] / a
    c = np.sqrt(seen.cov[1, 1] - b * b)
    first = seen.scale[0] / a
    return np.stack([first, (seen.scale[1] - b * first) / c])
