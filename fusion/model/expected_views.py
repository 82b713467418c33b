# SPDX-License-Identifier: BSD-3-Clause
"""The markers of tracked robots that a camera is certain to see, and where in its image; and the motion of the camera
that explains where it shows them instead."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from calib.rig.camera import Camera, pixel_jacobians
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.pose import Pose, rotation_from_vector
from fusion.model.nearest import mutual_nearest
from fusion.model.observations import CameraArray, Exposures, MarkerTable
from fusion.model.states import States

MIN_FACING, MARGIN_PX = 0.35, 30.0  # of markers that a camera is certain to see
SEARCH_PX = 120.0  # largest image shift: 8 degrees at a focal length of 840 px
BIN_PX = 6.0
SHIFTED_PX = 2 * BIN_PX  # from where a shift predicts them
# Between expected and detected markers: robots that follow a camera at fault are expected pixels away, and discs of
# other markers are at least their own diameter away.
GATES_PX = (SHIFTED_PX, 10.0, 8.0, 8.0)
ITERATIONS, CONVERGED = 5, 1e-5  # Gauss-Newton steps, and the last one, rad and m: hundredths of a pixel
MOVED, TURNED = 6, 3  # free errors of a camera's pose: its rotation is first


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


def match_moved(
    camera: Camera, expected: Sequence[ExpectedViews], detected: Sequence[Array], free: int = MOVED
) -> tuple[Array, list[tuple[Index, Index]]]:
    """Find the motion of a camera by which it shows markers elsewhere.

    An image shift on which most pairs agree begins, and pairs within ever smaller gates determine the pose.

    Args:
        camera: as calibrated.
        expected: the markers of each frame.
        detected: (M, 2) all roundels of each frame, pixels.
        free: `MOVED`, or `TURNED` about its centre, which fewer markers determine.

    Returns:
        T_world_cam (4, 4), and rows of expected and of detected roundels by frame. Fewer pairs than free errors leave
        the pose as calibrated; these are the pairs by the shift, or by the last pose.
    """
    T, shift = camera.matrix(), _image_shift([view.uv for view in expected], detected)
    points = np.concatenate([view.points for view in expected], axis=1).T
    of_frame = np.cumsum([len(view.rows) for view in expected])[:-1]
    matches: list[tuple[Index, Index]] = []
    for gate in GATES_PX:
        moved = msgspec.structs.replace(camera, T_world_cam=Pose.from_matrix(T))
        uv = np.split(moved.project_world(points) + shift, of_frame)
        matches = [mutual_nearest(there, seen, gate) for there, seen in zip(uv, detected, strict=True)]
        shown = np.concatenate([v.points.T[rows] for v, (rows, _) in zip(expected, matches, strict=True)])
        if len(shown) < free:
            return camera.matrix(), matches
        measured = np.concatenate([seen[d] for seen, (_, d) in zip(detected, matches, strict=True)])
        T, shift = _fit_pose(camera, T, shown, measured, free), np.zeros(2)
    return T, matches


def _fit_pose(camera: Camera, T: Array, points: Array, measured: Array, free: int) -> Array:
    """T_world_cam (4, 4) for the images (N, 2) of points (N, 3), by Gauss-Newton from `T` with Cauchy weights, 1 px."""
    for _ in range(ITERATIONS):
        uv, _, J, _ = pixel_jacobians(camera, (points - T[:3, 3]) @ T[:3, :3])
        known = np.isfinite(uv).all(1)
        J, off = J[known, :, :free], (measured - uv)[known]
        weighted = J / (1 + np.sum(off**2, 1))[:, None, None]
        H = np.einsum("nai,naj->ij", weighted, J) + 1e-9 * np.eye(free)
        step = np.zeros(MOVED)
        step[:free] = np.linalg.solve(H, np.einsum("nai,na->i", weighted, off))
        T = T.copy()
        T[:3, 3] += T[:3, :3] @ step[3:]
        T[:3, :3] = T[:3, :3] @ rotation_from_vector(step[:3])
        if np.abs(step).max() < CONVERGED:
            break
    return T


def _image_shift(expected: Sequence[Array], detected: Sequence[Array]) -> Array:
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
