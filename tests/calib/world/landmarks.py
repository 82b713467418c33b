# SPDX-License-Identifier: BSD-3-Clause
"""Stationary roundels at surveyed places of a synthetic arena."""

from dataclasses import replace

import numpy as np

from calib.rig.camera import transform
from calib.rig.rig import Rig
from calib.world.world_frame import move_rig
from camera_node.detection.roundels import Roundels
from camera_node.geometry.pose import invert, rotation_from_vector
from camera_node.protocol.messages import Detections
from tests.calib.synthetic import Arena, outlines

L_FRAME = {"0": [0.0, 0.0, 0.0], "1": [0.5, 0.0, 0.0], "2": [0.0, 0.3, 0.0]}


def see_discs(
    arena: Arena, landmarks: dict[str, list[float]], normal: list[float], radius: float
) -> list[Detections]:
    """One frame of each camera without noise: the ellipses of the landmarks' discs, which have this normal."""
    messages = []
    for name, camera in arena.truth.cameras.items():
        T = invert(camera.matrix())
        n = np.tile(T[:3, :3] @ normal, (len(landmarks), 1))
        uv, axes, angle = outlines(camera, transform(T, list(landmarks.values())), n, radius)
        columns = replace(Roundels.from_points(uv, 0.05), axes_px=axes, angle_rad=angle)
        header = {"camera": name, "seq": 0, "t_ns": 0, "width": 800, "height": 600}
        messages.append(Detections.pack(columns, **header))
    return messages


def detect_landmarks(
    arena: Arena, landmarks: dict[str, list[float]], numbered: bool = False, clutter: int = 3
) -> list[Detections]:
    """Ten frames of each camera: the landmarks as points with noise of 0.05 px, `clutter` stationary false roundels and
    one that jumps."""
    rng, messages = np.random.default_rng(2), []
    for name, camera in arena.truth.cameras.items():
        uv = camera.project_world(list(landmarks.values()))
        false = rng.uniform([20, 20], [780, 580], (clutter, 2))
        ids = np.array([int(n) if numbered else -1 for n in landmarks] + [-1] * clutter, np.int32)
        for seq in range(10):
            noisy = np.vstack([uv, false]) + 0.05 * rng.standard_normal((len(ids), 2))
            moving = rng.uniform([20, 20], [780, 580], (1, 2))
            columns = Roundels.from_points(np.vstack([noisy, moving]), 0.05, np.append(ids, np.int32(-1)))
            header = {"camera": name, "seq": seq, "t_ns": seq * 10**8, "width": 800, "height": 600}
            messages.append(Detections.pack(columns, **header))
    return messages


def in_another_world(rig: Rig) -> Rig:
    """The rig in a world that is rotated and shifted."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_vector([0.1, -0.2, 2.0]), [1.0, -2.0, 0.5]
    return move_rig(rig, T)
