# SPDX-License-Identifier: BSD-3-Clause
"""Projects discs into all cameras of a rig.

`native/disc_view.hpp` states the projection, `native/linearization.cpp` its derivatives. All of it works in the
undistorted image plane x/z, y/z; `CalibratedFrame.measure` undistorts each detection once, on arrival. Arrays store
columns: (3, N) for N vectors.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.rig.camera import Camera
from camera_node.foundation.arrays import Array, Index
from fusion import _core
from fusion.model.states import States
from fusion.model.undistortion import table_of


@dataclass(frozen=True, slots=True, eq=False)
class Exposures:
    """F frames.

    Attributes:
        camera: (F,) index of the camera.
        tau: (F,) capture time minus the time of the states, seconds.
        tau_sigma: (F,) its standard deviation by the clock, seconds.
        line_s: (F,) time from one row to the next of a rolling shutter, seconds.
    """

    camera: Index
    tau: Array
    tau_sigma: Array
    line_s: Array

    @classmethod
    def exact(cls, camera: Index, tau: Array) -> "Exposures":
        """Frames of exactly known time."""
        return cls(camera, tau, *np.zeros((2, len(tau))))


@dataclass(frozen=True, slots=True, eq=False)
class Discs:
    """N discs, each in one frame and on one body.

    Attributes:
        frame: (N,) row of the exposures.
        body: (N,) row of the states.
        marker: (N,) row of the marker table; identifies the marker.
        position, normal: (3, N) centre, and unit normal out of the print; body frame.
        radius: (N,) of the black disc, metres.
        delay: (N,) time from the frame to the capture of the disc's row by a rolling shutter, seconds; None for 0.
    """

    frame: Index
    body: Index
    marker: Index
    position: Array
    normal: Array
    radius: Array
    delay: Array | None = None

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def columns(self) -> _core.DiscColumns:
        """The arrays for the native core."""
        delay = np.zeros(len(self)) if self.delay is None else self.delay
        return _core.DiscColumns(self.frame, self.body, self.position, self.normal, self.radius, delay)

    def select(self, rows: NDArray) -> "Discs":
        """The columns of a mask or an index array."""
        columns = [column for name in self.__slots__ if (column := getattr(self, name)) is not None]
        return Discs(*take_columns(rows, *columns))


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
        revision: counts the changes of camera poses.
    """

    def __init__(self, cameras: dict[str, Camera]) -> None:
        self.names = tuple(cameras)
        self.index = {name: k for k, name in enumerate(cameras)}
        self._cameras = dict(cameras)
        self.revision = 0
        for camera in cameras.values():
            table_of(camera)  # so that the first frame does not wait for it
        self._update()

    def __getitem__(self, name: str) -> Camera:
        return self._cameras[name]

    def as_dict(self) -> dict[str, Camera]:
        """A copy of all cameras by name."""
        return dict(self._cameras)

    def place(self, name: str, camera: Camera) -> None:
        """Replace the pose of a camera."""
        self._cameras[name] = camera
        self.revision += 1
        self._update()

    def _update(self) -> None:
        cameras = self._cameras.values()
        T = np.array([camera.matrix() for camera in cameras]).reshape(-1, 4, 4)
        self.R_cam_world = np.ascontiguousarray(T[:, :3, :3].transpose(0, 2, 1))
        self.centres = np.ascontiguousarray(T[:, :3, 3])
        self.focal = np.array([(camera.fx + camera.fy) / 2 for camera in cameras])

    def frame_poses(self, states: States, exposures: Exposures) -> _core.FramePoses:
        """The poses of all bodies at the capture times of all frames."""
        k = exposures.camera
        cameras = _core.CameraExposures(
            self.R_cam_world[k], self.centres[k], exposures.tau, exposures.tau_sigma
        )
        return _core.FramePoses(states.bodies, cameras)

    def views(self, states: States, exposures: Exposures, discs: Discs) -> Views:
        """Project discs at the capture times of their frames."""
        rows = self.frame_poses(states, exposures).views(discs.columns)
        return Views(rows[:3], rows[3:6], rows[6:9], rows[9:])

    def rays(self, camera: Index, xy: Array) -> Array:
        """Unit viewing rays (N, 3), world frame, of undistorted xy (2, N)."""
        rays = np.column_stack([*xy, np.ones(len(camera))])
        rays /= np.sqrt(np.einsum("ni,ni->n", rays, rays))[:, None]
        return np.einsum("nij,ni->nj", self.R_cam_world[camera], rays)


def take_columns(rows: NDArray, *arrays: NDArray) -> Iterator[NDArray]:
    """The columns of a mask or an index array, contiguous in memory."""
    rows = np.flatnonzero(rows) if rows.dtype == bool else rows
    return (A.take(rows, -1) for A in arrays)
