# SPDX-License-Identifier: BSD-3-Clause
"""What the cameras of a rig should see of discs in the world.

The equations stand in `native/disc_view.hpp`, their derivatives in `native/linearisation.cpp`. All of it happens in the
undistorted plane x/z, y/z: `Frame.measure` takes detections there once, as they arrive. Arrays hold one row's N columns
last, (3, N) for N vectors.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.rig.camera import Camera
from camera_node.arrays import Array, Index
from fusion._core import Poses
from fusion.model.states import States
from fusion.model.undistortion import table_of


@dataclass(frozen=True, slots=True, eq=False)
class Exposures:
    """F frames: the index of the camera (F,), and capture time less the states' time (F,), seconds."""

    camera: Index
    tau: Array


@dataclass(frozen=True, slots=True, eq=False)
class Discs:
    """N discs, each in one frame.

    Attributes:
        frame: (N,) row in the exposures.
        body: (N,) row in the states.
        row: (N,) tells markers apart.
        marker: (3, N) centre in the body's frame.
        radius: (N,) of the black disc, metres.
    """

    frame: Index
    body: Index
    row: Index
    marker: Array
    radius: Array

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def columns(self) -> tuple[Index, Index, Array, Array]:
        """As the core takes them: frame, body, marker and radius."""
        return self.frame, self.body, self.marker, self.radius

    def select(self, rows: NDArray) -> "Discs":
        """The columns that a mask or an index array names."""
        return Discs(*taken(rows, *(getattr(self, name) for name in self.__slots__)))


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """What N discs look like, camera frame: centre and normal (3, N), the outline's centre q (3, N) and xy (2, N).

    `xy` is NaN where a disc is not before its camera.
    """

    centre: Array
    normal: Array
    q: Array
    xy: Array

    def select(self, rows: NDArray) -> "Views":
        """The columns that a mask or an index array names."""
        return Views(*taken(rows, *(getattr(self, name) for name in self.__slots__)))

    @property
    def facing(self) -> Array:
        """(N,) cosine between the normal and the direction to the camera: above 0 if the print is visible."""
        along = np.einsum("in,in->n", self.normal, self.centre)
        return -along / np.sqrt(np.einsum("in,in->n", self.centre, self.centre))


class CameraArray:
    """The placed cameras of a rig, by index in the order of `names`."""

    def __init__(self, cameras: dict[str, Camera]) -> None:
        self.names = tuple(cameras)
        self.index = {name: k for k, name in enumerate(cameras)}
        self.cameras = tuple(cameras.values())
        for camera in self.cameras:
            table_of(camera)  # before the first frame has to wait for it
        self._set()

    def place(self, name: str, camera: Camera) -> None:
        """A camera stands elsewhere."""
        self.cameras = tuple(camera if k == self.index[name] else old for k, old in enumerate(self.cameras))
        self._set()

    def _set(self) -> None:
        T = np.array([camera.matrix() for camera in self.cameras]).reshape(-1, 4, 4)
        self.R_cam_world = np.ascontiguousarray(T[:, :3, :3].transpose(0, 2, 1))
        self.centres = np.ascontiguousarray(T[:, :3, 3])
        self.focal = np.array([(camera.fx + camera.fy) / 2 for camera in self.cameras])

    def pose(self, states: States, exposures: Exposures) -> Poses:
        """Bodies at each frame's own time."""
        bodies = states.R, states.p, states.omega, states.v
        return Poses(
            *bodies, self.R_cam_world[exposures.camera], self.centres[exposures.camera], exposures.tau
        )

    def view(self, poses: Poses, discs: Discs) -> Views:
        """See `Views`."""
        rows = poses.view(*discs.columns)
        return Views(rows[:3], rows[3:6], rows[6:9], rows[9:])

    def rays(self, camera: Index, xy: Array) -> Array:
        """Unit viewing rays (N, 3) in the world of undistorted xy (2, N)."""
        rays = np.column_stack([*xy, np.ones(len(camera))])
        rays /= np.sqrt(np.einsum("ni,ni->n", rays, rays))[:, None]
        return np.einsum("nij,ni->nj", self.R_cam_world[camera], rays)


def taken(rows: NDArray, *arrays: NDArray) -> Iterator[NDArray]:
    """The columns that a mask or an index array names, left along memory, as indexing would not leave them."""
    rows = np.flatnonzero(rows) if rows.dtype == bool else rows
    return (A.take(rows, -1) for A in arrays)
