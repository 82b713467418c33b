# SPDX-License-Identifier: BSD-3-Clause
"""The markers of tracked robots that a camera is certain to see, and where in its image; and the image shift by which a
camera shows them elsewhere."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from camera_node.foundation.arrays import Array, Index
from fusion.model.observations import CameraArray, Exposures, MarkerTable
from fusion.model.states import States

MIN_FACING, MARGIN_PX = 0.35, 30.0  # of markers that a camera is certain to see
SEARCH_PX = 120.0  # largest image shift: 8 degrees at a focal length of 840 px
BIN_PX = 6.0
SHIFTED_PX = 2 * BIN_PX  # from where a shift predicts them


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


def image_shift(expected: Iterable[Array], detected: Iterable[Array]) -> Array:
    """(2,) the image shift on which most pairs of expected and detected roundels agree, pixels.

    Args:
        expected, detected: (N, 2) and (M, 2) of each frame of a camera, pixels.
    """
    size = int(SEARCH_PX / BIN_PX)
    votes = np.zeros((2 * size + 1, 2 * size + 1))
    pairs = zip(expected, detected, strict=True)
    off = np.concatenate([(there[None] - uv[:, None]).reshape(-1, 2) for uv, there in pairs])
    off = off[(np.abs(off) < SEARCH_PX).all(1)]
    np.add.at(votes, tuple(np.round(off / BIN_PX).astype(int).T + size), 1)
    smooth = sum(np.roll(votes, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1))
    best = (np.array(np.unravel_index(np.argmax(smooth), votes.shape)) - size) * BIN_PX
    near = off[np.linalg.norm(off - best, axis=1) < SHIFTED_PX]
    return np.median(near, axis=0) if len(near) else np.zeros(2)
