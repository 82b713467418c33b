# SPDX-License-Identifier: BSD-3-Clause
"""The cameras of a rig, the discs of all robots, and the detections of a frame set, as columns.

`native/disc_view.hpp` states the projection of a disc, `native/linearization.cpp` its derivatives. All of it works in
the undistorted image plane x/z, y/z; `CalibratedFrame.measure` undistorts each detection once, on arrival. Arrays store
columns: (3, N) for N vectors.
"""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calib.rig.camera import Camera
from calib.rig.camera_errors import error_covariance, errors_of_size, image_errors
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.foundation.columns import Columns
from camera_node.geometry.outline import half_axes_of
from fusion import _core
from fusion._core import SLACK_PX
from fusion.model.corrections import with_errors_of
from fusion.model.frames import FrameSet
from fusion.model.marker_places import PLACE_M, frame_covariance
from fusion.model.robots import Robot
from fusion.model.states import States
from fusion.model.undistortion import (
    CODE,
    COV,
    DELAY,
    N_ROWS,
    OUTLINE,
    ROTATION,
    ROTATION_SIGMA,
    SCALE,
    UV,
    XY,
    table_of,
)

EXACT_S = 2e-5  # at 2 m/s the error of a capture time within this is below 0.05 mm
MAX_ERROR_PX = 3.0  # of a camera, to assign its detections: gates of three times as much reach other roundels


@dataclass(frozen=True, slots=True, eq=False)
class Exposures:
    """F frames.

    Attributes:
        camera: (F,) index of the camera.
        tau: (F,) capture time minus the time of the states, seconds.
        clock_sigma: (F,) its standard deviation by the clock, which frames have in common, seconds.
        stamp_sigma: (F,) by errors of single stamps, seconds.
        line_s: (F,) time from one row to the next of a rolling shutter, seconds.
    """

    camera: Index
    tau: Array
    clock_sigma: Array
    stamp_sigma: Array
    line_s: Array

    @property
    def tau_sigma(self) -> Array:
        """(F,) standard deviation of `tau`, seconds."""
        return np.hypot(self.clock_sigma, self.stamp_sigma)

    @property
    def are_exact(self) -> bool:
        """Whether the times of all frames are known so well that no motion shows their errors."""
        return not (self.tau_sigma > EXACT_S).any()

    @classmethod
    def exact(cls, camera: Index, tau: Array) -> "Exposures":
        """Frames of exactly known time."""
        return cls(camera, tau, *np.zeros((3, len(tau))))


@dataclass(frozen=True, slots=True, eq=False)
class Discs(Columns):
    """N discs, each in one frame and on one body.

    Attributes:
        frame: (N,) row of the exposures.
        body: (N,) row of the states.
        marker: (N,) row of the marker table; identifies the marker.
        position, normal: (3, N) centre, and unit normal out of the print; body frame.
        radius: (N,) of the black disc, metres.
        delay: (N,) time from the frame to the capture of the disc's row by a rolling shutter, seconds; None for 0.
        zero: (3, N) unit vector to the zero of the disc's code; body frame. None where no code is read.
    """

    ROW_AXIS: ClassVar[int] = -1

    frame: Index
    body: Index
    marker: Index
    position: Array
    normal: Array
    radius: Array
    delay: Array | None = None
    zero: Array | None = None

    @property
    def columns(self) -> _core.DiscColumns:
        """The arrays for the native core."""
        delay = np.zeros(len(self)) if self.delay is None else self.delay
        return _core.DiscColumns(self.frame, self.body, self.position, self.normal, self.radius, delay)


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """N projected discs.

    Attributes:
        centre, normal: (3, N) of the disc, camera frame.
        q: (3, N) point that projects to the centre of the outline, camera frame.
        xy: (2, N) centre of the outline, undistorted; NaN where the disc is behind the camera.
    """

    centre: Array
    normal: Array
    q: Array
    xy: Array

    @property
    def facing(self) -> Array:
        """(N,) cosine between the normal and the direction to the camera: positive where the print is visible."""
        along = np.einsum("in,in->n", self.normal, self.centre)
        return -along / np.sqrt(np.einsum("in,in->n", self.centre, self.centre))


class CameraArray:
    """The placed cameras of a rig, by index in the order of `names`.

    Attributes:
        R_cam_world: (C, 3, 3).
        centres: (C, 3) centres of projection, world frame.
        focal: (C,) mean focal lengths, pixels.
        height: (C,) rows of the images.
        area_px2: (C,) of the images.
        covariance: (8 C, 8 C) of the errors of the cameras, which claims contain; see `calib.rig.camera_errors`.
        error_px: (C,) what these errors displace in the images, RMS of a coordinate, at most `MAX_ERROR_PX`: by these,
            detections are weighed, associated and searched.
        error_scale: factor of the standard deviations that the rig states.
        size_error: of the whole rig, relative; errors of its size are counted beside those that it states.
        revision: counts the changes of camera poses and of their errors.
    """

    def __init__(self, cameras: dict[str, Camera], error_scale: float = 1.0) -> None:
        self.names = tuple(cameras)
        self.index = {name: k for k, name in enumerate(cameras)}
        self._cameras, self.error_scale, self.size_error = dict(cameras), error_scale, 0.0
        self.revision = 0
        for camera in cameras.values():
            table_of(camera)  # so that the first frame does not wait for it
        self._update()

    def __getitem__(self, name: str) -> Camera:
        return self._cameras[name]

    def as_dict(self) -> dict[str, Camera]:
        """A copy of all cameras by name."""
        return dict(self._cameras)

    def stated(self, error_scale: float) -> "CameraArray":
        """The cameras as they are now, of which the errors that the rig states count this many times as large."""
        if (self.error_scale, self.size_error) == (error_scale, 0.0):
            return copy(self)
        return CameraArray(self._cameras, error_scale)

    def place(self, cameras: Mapping[str, Camera]) -> None:
        """Replace the poses of cameras."""
        self._cameras = {**self._cameras, **cameras}
        self.revision += 1
        self._update()

    def state_errors(self, cameras: Mapping[str, Camera]) -> None:
        """Take the errors (`Camera.errors`) that a rig of the same cameras states."""
        if cameras:
            self._cameras = with_errors_of(self._cameras, cameras)
            self.revision += 1
            self._update()

    def count_errors(self, scale: float, size_error: float) -> None:
        """Count the errors that the rig states this many times as large, and an error of its size."""
        if (scale, size_error) != (self.error_scale, self.size_error):
            self.error_scale, self.size_error = scale, size_error
            self.revision += 1
            self._update()

    def _update(self) -> None:
        cameras = self._cameras.values()
        T = np.array([camera.matrix() for camera in cameras]).reshape(-1, 4, 4)
        self.R_cam_world = np.ascontiguousarray(T[:, :3, :3].transpose(0, 2, 1))
        self.centres = np.ascontiguousarray(T[:, :3, 3])
        self.focal = np.array([(camera.fx + camera.fy) / 2 for camera in cameras])
        self.height = np.array([camera.height for camera in cameras])
        self.area_px2 = np.array([camera.width * camera.height for camera in cameras], float)
        self.errors_of_size = errors_of_size(T)
        of_size = self.size_error * self.errors_of_size
        self.covariance = self.error_scale**2 * error_covariance(list(cameras)) + np.outer(of_size, of_size)
        self.error_px = np.minimum(image_errors(list(cameras), self.covariance), MAX_ERROR_PX)

    def frame_poses(self, states: States, exposures: Exposures) -> _core.FramePoses:
        """The poses of all bodies at the capture times of all frames."""
        return _core.FramePoses(states.bodies, self.exposed(exposures))

    def exposed(self, exposures: Exposures) -> _core.CameraExposures:
        """The frames for the native core."""
        k = exposures.camera
        at = self.R_cam_world[k], self.centres[k]
        return _core.CameraExposures(*at, exposures.tau, exposures.tau_sigma)

    def views(self, states: States, exposures: Exposures, discs: Discs) -> Views:
        """Project discs at the capture times of their frames."""
        rows = self.frame_poses(states, exposures).views(discs.columns)
        return Views(rows[:3], rows[3:6], rows[6:9], rows[9:])

    def rays(self, camera: Index, xy: Array) -> Array:
        """Unit viewing rays (N, 3), world frame, of undistorted xy (2, N)."""
        rays = np.column_stack([*xy, np.ones(len(camera))])
        rays /= np.sqrt(np.einsum("ni,ni->n", rays, rays))[:, None]
        return np.einsum("nij,ni->nj", self.R_cam_world[camera], rays)


@dataclass(frozen=True, slots=True, eq=False)
class DetectionTable(Columns):
    """All N detections of a frame set, by columns.

    Attributes:
        exposures: the frames of the set.
        frame: (N,) row of the exposures.
        columns: (19, N) everything else, by rows; the properties are views of it.
    """

    ROW_AXIS: ClassVar[int] = -1
    SHARED: ClassVar[frozenset[str]] = frozenset({"exposures"})

    exposures: Exposures
    frame: Index
    columns: Array

    @property
    def uv(self) -> Array:
        """(2, N) raw pixels."""
        return self.columns[UV]

    @property
    def cov(self) -> Array:
        """(2, 2, N) covariances of `uv`, pixels^2."""
        return self.columns[COV].reshape(2, 2, -1)

    @property
    def axes_px(self) -> Array:
        """(2, N) full axes of the outline, NaN where unknown."""
        return self.columns[OUTLINE][:2]

    @property
    def angle_rad(self) -> Array:
        """(N,) direction of the major axis of the outline, NaN where unknown."""
        return self.columns[OUTLINE][2]

    @property
    def xy(self) -> Array:
        """(2, N) centre of the undistorted outline; NaN where the lens has no inverse."""
        return self.columns[XY]

    @property
    def scale(self) -> Array:
        """(2, 2, N) Jacobians of raw pixels with respect to `xy`."""
        return self.columns[SCALE].reshape(2, 2, -1)

    @property
    def code(self) -> NDArray[np.int32]:
        """(N,) of the roundel, where it was read; otherwise -1."""
        return self.columns[CODE].astype(np.int32)

    @property
    def rotation(self) -> Array:
        """(N,) of the code, see `Roundels`; NaN where unknown."""
        return self.columns[ROTATION]

    @property
    def rotation_sigma(self) -> Array:
        """(N,) of the rotation; NaN where unknown."""
        return self.columns[ROTATION_SIGMA]

    @property
    def delay(self) -> Array:
        """(N,) time from the frame to the capture of the detection's row by a rolling shutter, seconds."""
        return self.columns[DELAY]

    def replaced(self, rows: slice, values: Array) -> "DetectionTable":
        """The same with other values in these rows of `columns`."""
        columns = self.columns.copy()
        columns[rows] = values.reshape(columns[rows].shape)
        return replace(self, columns=columns)

    @property
    def camera(self) -> Index:
        """(N,) index of the camera."""
        return self.exposures.camera[self.frame]

    @property
    def variance_px2(self) -> Array:
        """(N,) mean variance of the two coordinates of a centre, px^2."""
        return (self.cov[0, 0] + self.cov[1, 1]) / 2

    @property
    def tau(self) -> Array:
        """(N,) capture time minus the time of the frame set, seconds."""
        return self.exposures.tau[self.frame] + self.delay

    @property
    def native(self) -> _core.DetectionColumns:
        """The arrays for the native core."""
        rows = self.axes_px[0], self.columns[CODE], self.delay
        return _core.DetectionColumns(self.frame, self.xy, self.scale, self.cov, *rows)

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
    def of(cls, frame_set: FrameSet, cameras: CameraArray) -> "DetectionTable":
        """The detections of a frame set; errors of the cameras are added to the noise that detectors report."""
        frames = frame_set.frames
        camera = np.array([cameras.index[frame.camera] for frame in frames], np.intp)
        times = [
            (1e-9 * (f.t_ns - frame_set.t_ns), f.clock_sigma_s, f.stamp_sigma_s, f.readout_s) for f in frames
        ]
        tau, clock_sigma, stamp_sigma, readout_s = np.array(times).reshape(-1, 4).T.copy()
        exposures = Exposures(camera, tau, clock_sigma, stamp_sigma, readout_s / cameras.height[camera])
        counts = [frame.columns.shape[1] for frame in frames]
        row = np.repeat(np.arange(len(frames)), counts)
        columns = np.concatenate([np.empty((N_ROWS, 0)), *(frame.columns for frame in frames)], axis=1)
        columns[COV][::3] += (cameras.error_px**2)[camera[row]]
        if exposures.line_s.any():
            columns[DELAY] = np.concatenate([frame.delays(cameras[frame.camera]) for frame in frames])
        return cls(exposures, row, columns)


def _zeros(robot: Robot) -> Array:
    """(3, M) see `MarkerTable`."""
    return robot.code_axes.T if robot.needs_headings else np.full((3, len(robot.markers)), np.nan)


def _frame_covariance(robot: Robot) -> Array:
    """(6, 6) see `MarkerTable`, by the tolerance of places that were measured or drawn."""
    return frame_covariance(robot.points, PLACE_M**2 * np.eye(3 * len(robot.markers)))


@dataclass(frozen=True, slots=True, eq=False)
class MarkerTable(Columns):
    """All K markers of all robots.

    Attributes:
        robot: (K,) row of the robot.
        number: (K,) index in the robot.
        position, normal: (3, K) centre, and unit normal out of the print; body frame.
        radius: (K,) of the black disc, metres.
        code: (K,) of the marker, 0 for none.
        zero: (3, K) direction of its zero, body frame; NaN for robots that need no headings (`Body.needs_headings`).
        first: (R + 1,): robot r has the rows first[r] to first[r + 1].
        frame: (R, 6, 6) covariance of the rotation and position (body frame) of each robot by errors of the places.
    """

    ROW_AXIS: ClassVar[int] = -1
    SHARED: ClassVar[frozenset[str]] = frozenset({"first", "frame"})

    robot: Index
    number: Index
    position: Array
    normal: Array
    radius: Array
    code: Index
    zero: Array
    first: Index
    frame: Array

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
            np.concatenate([np.empty(0, np.intp), *(robot.codes for robot in robots)]).astype(np.intp),
            np.concatenate([np.empty((3, 0)), *(_zeros(robot) for robot in robots)], axis=1),
            np.concatenate([[0], np.cumsum(counts)]).astype(np.intp),
            np.array([_frame_covariance(robot) for robot in robots]).reshape(-1, 6, 6),
        )

    def place(self, robot: int, position: Array, frame: Array) -> None:
        """The markers of a robot are at other places (m, 3), with this covariance (6, 6) of its frame."""
        self.position[:, self.first[robot] : self.first[robot + 1]] = position.T
        self.frame[robot] = frame

    def discs(self, rows: Index, frame: Index) -> Discs:
        """The markers `rows`, each in one frame."""
        return Discs(frame, self.robot[rows], rows, *self._shapes(rows), zero=self.zero.take(rows, 1))

    def expected(self, rows: Index, states: States, body: Index | None = None) -> _core.ExpectedMarkers:
        """The markers `rows` with the covariances of their positions; `body` is the row of the states of each.

        Without `body`, the rows of the states are those of the robots.
        """
        body = self.robot[rows] if body is None else body
        return _core.ExpectedMarkers(states.R, states.P, body, self.code[rows], *self._shapes(rows))

    def _shapes(self, rows: Index) -> tuple[Array, Array, Array]:
        return self.position.take(rows, 1), self.normal.take(rows, 1), self.radius[rows]


@dataclass(frozen=True, slots=True, eq=False)
class Assignments(Columns):
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

    def with_residuals(self, squared_px: Array) -> "Assignments":
        """The same with squared residuals (N,), px^2."""
        return Assignments(self.detection, self.marker, squared_px)


@dataclass(frozen=True, slots=True, eq=False)
class MatchedObservations(Columns):
    """N detections and their discs. `whiten` (2, 2, N) scales errors in xy to unit covariance."""

    ROW_AXIS: ClassVar[int] = -1

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
        whiten = _core.whiten(detections.cov, detections.scale)
        return cls(replace(discs, delay=detections.delay), detections, whiten)

    def with_bodies(self, body: Index) -> "MatchedObservations":
        """The same of other bodies (N,), as of several states of one robot."""
        return replace(self, discs=replace(self.discs, body=body))

    def with_noise(self, added_px2: float) -> "MatchedObservations":
        """The same with a variance added to both coordinates of all centres, px^2."""
        noise = added_px2 * np.eye(2)[:, :, None]
        return self.of_discs(self.detections.replaced(COV, self.detections.cov + noise), self.discs)

    def misfit(self, squared_px: Array) -> Array:
        """(N,) squared residuals (N,), px^2, in standard deviations, including `SLACK_PX`; infinite where these are
        NaN: the disc is not visible."""
        d2 = squared_px / (self.detections.variance_px2 + SLACK_PX**2)
        return np.where(np.isnan(d2), np.inf, d2)


@dataclass(frozen=True, slots=True, eq=False)
class LinearizedObservations(Columns):
    """N observations, and the equations (N, 2, 13) of their centres about predicted bodies: whitened derivatives by the
    errors of the bodies, and innovations; zeros where the disc is not visible."""

    matched: MatchedObservations
    centres: Array

    @property
    def body(self) -> Index:
        """(N,) row of the states."""
        return self.matched.discs.body

    @property
    def camera(self) -> Index:
        """(N,) index of the camera."""
        return self.matched.detections.camera


def detection_density(cameras: CameraArray, detections: DetectionTable, frame: Index) -> Array:
    """(F,) detections per pixel^2 in each frame, of those in the frames (K,)."""
    area_px2 = cameras.area_px2[detections.exposures.camera]
    return np.bincount(frame, minlength=len(area_px2)) / area_px2


def mean_by_body(values: NDArray, body: Index, n_bodies: int) -> Array:
    """(B,) means of values (N,) of the bodies (N,); 0 for bodies without values."""
    return np.bincount(body, values, n_bodies) / np.maximum(np.bincount(body, minlength=n_bodies), 1)


def count_checked(robot: Index, camera: Index, n_robots: int) -> Index:
    """(R,) how many of the detections (N,) of robots by cameras each robot has; 0 where one camera alone sees it."""
    by_two = views(robot, camera, n_robots).sum(1) > 1
    return np.where(by_two, np.bincount(robot, minlength=n_robots), 0)


def views(robot: Index, camera: Index, n_robots: int) -> Mask:
    """(R, C) whether there are detections (N,) of each robot by each camera."""
    seen = np.zeros((n_robots, np.max(camera, initial=0) + 1), bool)
    seen[robot, camera] = True
    return seen
