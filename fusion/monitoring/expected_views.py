# SPDX-License-Identifier: BSD-3-Clause
"""The markers of tracked robots that a camera is certain to see, and where in its image."""

from dataclasses import dataclass

import numpy as np

from camera_node.arrays import Array, Index
from fusion.model.camera_array import CameraArray, Exposures
from fusion.model.observations import MarkerTable
from fusion.model.states import States

MIN_FACING, MARGIN_PX = 0.35, 30.0  # of markers that a camera is certain to see


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedViews:
    """N markers that a camera should see.

    Attributes:
        rows: (N,) of the marker table.
        points: (3, N) world frame; they project to the centres of the outlines.
        uv: (N, 2) these centres, pixels.
    """

    rows: Index
    points: Array
    uv: Array

    @classmethod
    def of(
        cls, cameras: CameraArray, name: str, states: States, tau: float, markers: tuple[MarkerTable, Index]
    ) -> "ExpectedViews":
        """Project markers into a camera; those at the edge of the image or seen edge-on are left out.

        Args:
            cameras: cameras of the rig.
            name: the camera.
            states: of all robots.
            tau: time of the frame minus that of the states, s.
            markers: the marker table and the rows that are projected.
        """
        table, rows = markers
        camera, lens = cameras.index[name], cameras[name]
        discs = table.discs(rows, np.zeros(len(rows), np.intp))
        views = cameras.views(states, Exposures.exact(np.array([camera]), np.array([tau])), discs)
        points = cameras.R_cam_world[camera].T @ views.q + cameras.centres[camera][:, None]
        uv, size = lens.project(views.q.T), np.array([lens.width, lens.height])
        seen = ((uv > MARGIN_PX) & (uv < size - MARGIN_PX)).all(1) & (views.facing > MIN_FACING)
        return cls(rows[seen], points[:, seen], uv[seen])
