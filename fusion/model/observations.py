# SPDX-License-Identifier: BSD-3-Clause
"""Tables of the detections of a frame set, of the markers of all robots, and of the assignments between them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.outline import half_axes_of
from fusion import _core
from fusion.model.camera_array import CameraArray, Discs, Exposures, take_columns
from fusion.model.frames import FrameSet
from fusion.model.robots import Robot
from fusion.model.states import States


@dataclass(frozen=True, slots=True, eq=False)
class DetectionTable:
    """All N detections of a frame set, by columns.

    Attributes:
        exposures: the frames of the set.
        frame: (N,) row of the exposures.
        delay: (N,) time from the frame to the capture of the detection's row by a rolling shutter, seconds.
        uv, cov: (2, N) raw pixels and (2, 2, N) their covariances, pixels^2.
        axes_px, angle_rad: (2, N) full axes and (N,) direction of the major axis of the outline, NaN where unknown.
        xy: (2, N) undistorted; NaN where the lens has no inverse.
        scale: (2, 2, N) Jacobians of raw pixels with respect to xy.
    """

    exposures: Exposures
    frame: Index
    delay: Array
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
        """(N,) capture time minus the time of the frame set, seconds."""
        return self.exposures.tau[self.frame] + self.delay

    @property
    def columns(self) -> _core.DetectionColumns:
        """The arrays for the native core."""
        return _core.DetectionColumns(self.frame, self.xy, self.scale, self.cov, self.axes_px[0], self.delay)

    def select(self, rows: NDArray) -> "DetectionTable":
        """The columns of a mask or an index array."""
        arrays = self.frame, self.delay, self.uv, self.cov, self.axes_px, self.angle_rad, self.xy, self.scale
        return DetectionTable(self.exposures, *take_columns(rows, *arrays))

    def conics(self) -> Array:
        """(N, 3, 3) conics Q of outlines, p^T Q p = 0 for undistorted p = (x, y, 1); NaN where the axes are unknown.

        The lens is taken as affine over an outline.
        """
        half = np.linalg.solve(self.scale.transpose(2, 0, 1), half_axes_of(self.axes_px.T, self.angle_rad))
        m = np.column_stack([*self.xy, np.ones(len(self))])
        dual = m[:, :, None] * m[:, None]
        dual[:, :2, :2] -= half @ half.transpose(0, 2, 1)
        return -np.asarray(np.linalg.inv(dual), float)

    @classmethod
    def of(cls, frame_set: FrameSet, cameras: CameraArray, floor_px: float) -> "DetectionTable":
        """The detections of a frame set; `floor_px` is added in quadrature to the noise that detectors report."""
        frames = frame_set.frames
        exposures = Exposures(
            np.array([cameras.index[frame.camera] for frame in frames], np.intp),
            np.array([(frame.t_ns - frame_set.t_ns) * 1e-9 for frame in frames]),
            np.array([frame.clock_sigma_s for frame in frames]),
            np.array([frame.readout_s / cameras[frame.camera].height for frame in frames]),
        )
        row = np.repeat(np.arange(len(frames)), [len(frame.roundels) for frame in frames])
        cov = _concatenate([f.roundels.cov.transpose(1, 2, 0) for f in frames], (2, 2, 0))
        cov[[0, 1], [0, 1]] += floor_px**2
        return cls(
            exposures,
            row,
            _concatenate([f.delays(cameras[f.camera]) for f in frames], (0,)),
            _concatenate([f.roundels.uv.T for f in frames], (2, 0)),
            cov,
            _concatenate([f.roundels.axes_px.T for f in frames], (2, 0)),
            _concatenate([f.roundels.angle_rad for f in frames], (0,)),
            _concatenate([f.xy for f in frames], (2, 0)),
            _concatenate([f.scale for f in frames], (2, 2, 0)),
        )


def _concatenate(columns: list[Array], empty: tuple[int, ...]) -> Array:
    return np.concatenate([np.zeros(empty), *columns], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class MarkerTable:
    """All K markers of all robots.

    Attributes:
        robot: (K,) row of the robot.
        number: (K,) index in the robot.
        position, normal: (3, K) centre, and unit normal out of the print; body frame.
        radius: (K,) of the black disc, metres.
        first: (R + 1,): robot r has the rows first[r] to first[r + 1].
    """

    robot: Index
    number: Index
    position: Array
    normal: Array
    radius: Array
    first: Index

    @classmethod
    def of(cls, robots: list[Robot]) -> "MarkerTable":
        """The markers of these robots, in order."""
        counts = [len(robot.markers) for robot in robots]
        return cls(
            np.repeat(np.arange(len(robots)), counts),
            np.concatenate([np.empty(0, np.intp), *(np.arange(n) for n in counts)]).astype(np.intp),
            np.concatenate([np.empty((3, 0)), *(robot.points.T for robot in robots)], axis=1),
            np.concatenate([np.empty((3, 0)), *(robot.unit_normals.T for robot in robots)], axis=1),
            np.repeat([robot.diameter_m / 2 for robot in robots], counts),
            np.concatenate([[0], np.cumsum(counts)]).astype(np.intp),
        )

    def __len__(self) -> int:
        return len(self.robot)

    def discs(self, rows: Index, frame: Index) -> Discs:
        """The markers `rows`, each in one frame."""
        position, normal = take_columns(rows, self.position, self.normal)
        return Discs(frame, self.robot[rows], rows, position, normal, self.radius[rows])

    def expected(self, rows: Index, states: States, body: Index | None = None) -> _core.ExpectedMarkers:
        """The markers `rows` with the covariances of their positions; `body` is the row of the states of each.

        Without `body`, the rows of the states are those of the robots.
        """
        body = self.robot[rows] if body is None else body
        position, normal = take_columns(rows, self.position, self.normal)
        return _core.ExpectedMarkers(states.R, states.P, body, position, normal, self.radius[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Assignments:
    """Rows of the detection table, the rows of the marker table that they belong to, and squared residuals, px^2.

    The residuals are NaN before the estimate.
    """

    detection: Index
    marker: Index
    squared_px: Array

    @classmethod
    def of(cls, detection: Index, marker: Index) -> "Assignments":
        """Assignments before the estimate."""
        return cls(detection, marker, np.full(len(marker), np.nan))

    @classmethod
    def none(cls) -> "Assignments":
        """No assignment."""
        return cls.of(np.empty(0, np.intp), np.empty(0, np.intp))

    def __len__(self) -> int:
        return len(self.detection)

    def with_residuals(self, residuals_px: Array) -> "Assignments":
        """The same with residuals (2, N)."""
        return Assignments(self.detection, self.marker, np.sum(residuals_px**2, 0))

    def select(self, rows: NDArray) -> "Assignments":
        """The rows of a mask or an index array."""
        return Assignments(self.detection[rows], self.marker[rows], self.squared_px[rows])

    def joined(self, *others: "Assignments") -> "Assignments":
        """These assignments, then the others."""
        parts = (self, *others)
        return Assignments(*(np.concatenate([getattr(part, k) for part in parts]) for k in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class MatchedObservations:
    """N detections and their discs. `whiten` (2, 2, N) scales errors in xy to unit covariance."""

    discs: Discs
    detections: DetectionTable
    whiten: Array

    @classmethod
    def of(
        cls, assignments: Assignments, detections: DetectionTable, marker_table: MarkerTable
    ) -> "MatchedObservations":
        """The observations of assignments."""
        seen = detections.select(assignments.detection)
        return cls.of_discs(seen, marker_table.discs(assignments.marker, seen.frame))

    @classmethod
    def of_discs(cls, detections: DetectionTable, discs: Discs) -> "MatchedObservations":
        """Detections of known discs, row by row, each captured when the detection was."""
        return cls(replace(discs, delay=detections.delay), detections, _whiten(detections))

    def __len__(self) -> int:
        return len(self.discs)

    def select(self, rows: NDArray) -> "MatchedObservations":
        """The observations of a mask or an index array."""
        return MatchedObservations(
            self.discs.select(rows), self.detections.select(rows), self.whiten[:, :, rows]
        )


def _whiten(detections: DetectionTable) -> Array:
    """L^-1 scale, where L L^T is the covariance of the detection."""
    a = np.sqrt(detections.cov[0, 0])
    b = detections.cov[0, 1] / a
    c = np.sqrt(detections.cov[1, 1] - b * b)
    first = detections.scale[0] / a
    return np.stack([first, (detections.scale[1] - b * first) / c])
