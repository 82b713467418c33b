# SPDX-License-Identifier: BSD-3-Clause
"""The markers of tracked robots that a camera is certain to see, and where in its image."""

from dataclasses import dataclass, replace

import numpy as np

from camera_node.foundation.arrays import Array, Index
from fusion.model.observations import CameraArray, Exposures, MarkerTable
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
        cls,
        cameras: CameraArray,
        name: str,
        states: States,
        tau: float,
        markers: tuple[MarkerTable, Index],
        readout_s: float = 0.0,
    ) -> "ExpectedViews":
        """Project markers into a camera; those at the edge of the image or seen edge-on are left out.

        Args:
            cameras: cameras of the rig.
            name: the camera.
            states: of all robots.
            tau: time of the frame minus that of the states, s.
            markers: the marker table and the rows that are projected.
            readout_s: of a rolling shutter (`Detections`); a marker is projected when its row is captured.
        """
        table, rows = markers
        camera, lens = cameras.index[name], cameras[name]
        discs = table.discs(rows, np.zeros(len(rows), np.intp))
        exposures = Exposures.exact(np.array([camera]), np.array([tau]))
        views = cameras.views(states, exposures, discs)
        if readout_s:
            row = np.nan_to_num(lens.image_row(lens.project(views.q.T))).clip(-0.5, 0.5)
            views = cameras.views(states, exposures, replace(discs, delay=readout_s * row))
        points = cameras.R_cam_world[camera].T @ views.q + cameras.centres[camera][:, None]
        uv, size = lens.project(views.q.T), np.array([lens.width, lens.height])
        seen = ((uv > MARGIN_PX) & (uv < size - MARGIN_PX)).all(1) & (views.facing > MIN_FACING)
        return cls(rows[seen], points[:, seen], uv[seen])
