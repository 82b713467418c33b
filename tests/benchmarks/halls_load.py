# SPDX-License-Identifier: BSD-3-Clause
"""Halls: rooms side by side without walls, each with four cameras in its corners, and robots everywhere."""

from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from calib.rig.camera import Camera
from camera_node.geometry.pose import Pose, look_at
from tests.benchmarks.fusion_load import DISTORTION, LENS, Load

ROOM_M = np.array([5.0, 4.0])
OF_ROOM = 4  # cameras
HEIGHT_M = 3.5  # of the cameras
FOCAL_PX = 600.0
MARGIN_M = 0.5  # of the floor that few cameras see


@dataclass(frozen=True)
class Hall(Load):
    """A load in a hall whose floor grows with the number of cameras: about four cameras see a place."""

    min_px: float = 6.0  # the detector needs as much

    @property
    def _grid(self) -> tuple[int, int]:
        """Rooms along x and y."""
        rooms = -(-self.cameras // OF_ROOM)
        columns = int(np.ceil(np.sqrt(rooms)))
        return columns, -(-rooms // columns)

    @property
    def half(self) -> np.ndarray:
        return ROOM_M * self._grid / 2 - MARGIN_M

    @cached_property
    def rig(self) -> dict[str, Camera]:
        """Cameras in the corners of the rooms, directed at the middle of their floors."""
        columns, _ = self._grid
        cameras: dict[str, Camera] = {}
        for k in range(self.cameras):
            room, corner = divmod(k, OF_ROOM)
            middle = (np.array([room % columns, room // columns]) + 0.5) * ROOM_M - ROOM_M * self._grid / 2
            at = middle + ROOM_M * (np.array([corner % 2, corner // 2]) - 0.5)
            pose = Pose.from_matrix(look_at([*at, HEIGHT_M], [*middle, 0.2]))
            camera = Camera(**LENS, distortion=DISTORTION, T_world_cam=pose)
            cameras[f"cam{k:02d}"] = msgspec.structs.replace(camera, fx=FOCAL_PX, fy=FOCAL_PX)
        return cameras
