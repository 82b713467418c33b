# SPDX-License-Identifier: BSD-3-Clause
"""Draws markers as points, with discs where their normals are known, frames of what cameras locate by themselves,
and the true positions and cameras of the demos."""

from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike

from camera_node.foundation.arrays import Array, Mask
from camera_node.geometry.pose import rotation_with_z, wxyz_from_rotation
from web.colours import LABELED, TRUE_POINT, UNLABELED
from web.scene.bodies import cylinder_mesh
from web.state.feed import ArenaState

MARKERS_S = 0.5  # markers disappear after so long without a message
DISC_RADIUS_M, DISC_HEIGHT_M = 0.03, 0.002
DISC_SIDES = 16
MIN_DISCS = 16  # of a batch, which has a fixed number of discs; the others have no size
NO_SIZE = 1e-6
TRUE_POINTS_S = 1.0  # true positions disappear after so long without a message
RECENT_S = 0.5  # frames disappear after so long without a message
AXES_M = 0.1  # of a roundel; cameras have twice the size


def free_markers(state: ArenaState) -> Mask:
    """(M,) the latest markers that are no prints of declared robots, which `RobotDrawing` draws; none if not recent."""
    if state.markers is None or state.age_s(state.markers) > MARKERS_S:
        return np.zeros(0, bool)
    message = state.markers.message
    is_declared = np.array([robot in state.declared for robot in message.robots] + [False])
    return ~is_declared[message.robot_index()]  # -1, of unlabeled markers, is the last one


def add_points(
    scene: viser.SceneApi, name: str, colour: tuple[int, int, int], size_m: float
) -> viser.PointCloudHandle:
    """Add a cloud of round points, which is not visible before `show_points`."""
    return scene.add_point_cloud(
        name,
        np.zeros((1, 3), np.float32),
        colour,
        point_size=size_m,
        point_shape="circle",
        precision="float32",
        visible=False,
    )


def show_points(cloud: viser.PointCloudHandle, points: ArrayLike) -> None:
    """Show points (N, 3) as a cloud; none hide it."""
    places = np.array(points, np.float32).reshape(-1, 3)
    cloud.visible = bool(len(places))
    if len(places):
        cloud.points = places


class MarkerCloud:
    """Markers as one point cloud: white if a robot has the marker, grey if it is unlabeled. Prints of declared robots
    are not in it."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._cloud = add_points(scene, "/markers", LABELED, 0.035)

    def draw(self, state: ArenaState) -> None:
        """Draw the latest markers, if they are recent."""
        free = free_markers(state)
        self._cloud.visible = bool(free.any())
        if state.markers is not None and free.any():
            message = state.markers.message
            labeled = message.robot_index()[free] >= 0
            self._cloud.points = message.positions()[free].astype(np.float32)
            self._cloud.colors = np.where(labeled[:, None], LABELED, UNLABELED).astype(np.uint8)


class MarkerDiscs:
    """Discs at the markers of the cloud with a known normal, printed side outwards: one batch for all."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self.batch: Any = None
        self._capacity = self.count = 0  # discs of the batch, and those that are drawn

    def draw(self, state: ArenaState) -> None:
        """Draw the latest markers, if they are recent."""
        free = free_markers(state)
        positions, normals = np.empty((2, 0, 3))
        if state.markers is not None and free.any():
            message = state.markers.message
            positions, normals = message.positions(), message.normals().astype(float)
            is_known = free & np.isfinite(positions).all(1) & np.isfinite(normals).all(1)
            positions, normals = positions[is_known], normals[is_known]
        if not len(positions) and not self.count:
            return
        self.count = len(positions)
        self._move(
            positions, wxyz_from_rotation(rotation_with_z(normals)) if self.count else np.empty((0, 4))
        )

    def _move(self, positions: Array, wxyzs: Array) -> None:
        n = len(positions)
        if n > self._capacity:
            self._capacity = max(MIN_DISCS, 2 * n)
            self.batch = None
        rest = self._capacity - n
        scales = np.concatenate([np.ones(n), np.full(rest, NO_SIZE)]).astype(np.float32)
        at = np.concatenate([positions, np.zeros((rest, 3))]).astype(np.float32)
        turned = np.concatenate([wxyzs, np.tile([1.0, 0.0, 0.0, 0.0], (rest, 1))]).astype(np.float32)
        if self.batch is None:
            mesh = cylinder_mesh(DISC_RADIUS_M, DISC_HEIGHT_M, DISC_SIDES)
            self.batch = self._scene.add_batched_meshes_simple(
                "/discs", *mesh, turned, at, batched_scales=scales, batched_colors=LABELED
            )
            return
        self.batch.batched_positions, self.batch.batched_wxyzs = at, turned
        self.batch.batched_scales = scales


class TruePoints:
    """The demo's true marker positions, one point cloud per simulated object."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.scene = scene
        self.clouds: dict[str, Any] = {}

    def draw(self, state: ArenaState) -> None:
        """Draw the positions in the demo's latest message, if it is recent."""
        recent = state.progress and state.age_s(state.progress) < TRUE_POINTS_S
        objects = state.progress.message.true_points if state.progress and recent else {}
        for name in self.clouds.keys() - objects.keys():
            self.clouds.pop(name).remove()
        for name, points in objects.items():
            if name not in self.clouds:
                self.clouds[name] = add_points(self.scene, f"/true/{name}", TRUE_POINT, 0.05)
            show_points(self.clouds[name], points)


class RelativeFrames:
    """All frames as one batched handle, which can not change its number; z is the more probable normal."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._handles: dict[str, tuple[int, viser.BatchedAxesHandle]] = {}

    def draw(self, state: ArenaState) -> None:
        """Draw the recent frames of the cameras whose poses are known."""
        cameras = moving_cameras(state)
        self._show("cameras", np.array(list(cameras.values())).reshape(-1, 4, 4), 2 * AXES_M)
        self._show("roundels", located_frames(state), AXES_M)

    def _show(self, name: str, T: Array, axes_m: float) -> None:
        n, handle = self._handles.get(name, (0, None))
        if handle is not None and n != len(T):
            handle.remove()
            del self._handles[name]
            handle = None
        if not len(T):
            return
        wxyzs, positions = wxyz_from_rotation(T[:, :3, :3]), T[:, :3, 3]
        if handle is None:
            added = self._scene.add_batched_axes(
                f"/relative/{name}", wxyzs, positions, axes_length=axes_m, axes_radius=axes_m / 25
            )
            self._handles[name] = len(T), added
        else:
            handle.batched_positions = positions.astype(np.float32)
            handle.batched_wxyzs = wxyzs.astype(np.float32)


def moving_cameras(state: ArenaState) -> dict[str, Array]:
    """T_world_cam (4, 4) of the cameras in the demo's latest message, if it is recent."""
    if state.progress is None or state.age_s(state.progress) >= RECENT_S:
        return {}
    return {name: pose.matrix() for name, pose in state.progress.message.true_cameras.items()}


def located_frames(state: ArenaState) -> Array:
    """T_world_roundel (N, 4, 4) of the roundels in the recent messages of all cameras whose poses are known."""
    placed = state.rig.placed() if state.rig else {}
    cameras = {name: camera.matrix() for name, camera in placed.items()} | moving_cameras(state)
    frames = [np.empty((0, 4, 4))]
    for name, timed in state.relative.items():
        if name in cameras and state.age_s(timed) < RECENT_S:
            seen = timed.message.unpack()
            T = np.tile(np.eye(4), (len(seen), 1, 1))
            T[:, :3, :3], T[:, :3, 3] = rotation_with_z(seen.normals[:, 0]), seen.position
            frames.append(cameras[name] @ T)
    return np.concatenate(frames)
