# SPDX-License-Identifier: BSD-3-Clause
"""Draws what cameras locate by themselves: a frame for each roundel, and those of the demo's moving cameras."""

import numpy as np
import viser

from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import rotation_with_z, wxyz_from_rotation
from web.state.feed import ArenaState

RECENT_S = 0.5  # frames disappear after so long without a message
AXES_M = 0.1  # of a roundel; cameras have twice the size


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
