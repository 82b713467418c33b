# SPDX-License-Identifier: BSD-3-Clause
"""A cube as a wand: recordings in which each camera sees the sides that face it."""

from collections.abc import Callable, Sequence

import numpy as np

from calib.rig.camera import transform
from calib.rig.wand_file import WandBody
from camera_node.foundation.arrays import Array, Mask
from camera_node.protocol.messages import Detections
from tests.calib.synthetic import Arena, ring, see_points

HALF, SIGMA_PX = 0.15, 0.2
CORNERS = 0.8 * HALF * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
NORMALS = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]])
UPRIGHT = np.array([0.0, 0.0, 1.0])


def cube() -> WandBody:
    """Four markers on each of the upright sides of a cube, numbered side by side."""
    points = [
        HALF * normal + u * np.cross(UPRIGHT, normal) + v * UPRIGHT for normal in NORMALS for u, v in CORNERS
    ]
    return WandBody(markers=tuple(map(tuple, np.array(points).tolist())))


CUBE = cube()


def sees_sides(most: int) -> Callable[[Array], Mask]:
    """The sides (4,) that a camera sees, from the cosines (4,) of the angles at which they face it: up to `most`."""

    def choose(cosine: Array) -> Mask:
        chosen = np.zeros(4, bool)
        chosen[np.argsort(-cosine)[:most]] = True
        return chosen & (cosine > 0.2)

    return choose


def wave(
    arena: Arena, sides: int, frames: int, seed: int, period_ns: int = 500_000_000, phase: float = 0.0
) -> list[Detections]:
    """Record the cube with the sides that face each camera most, numbered; `phase` of a period from camera to
    camera."""
    rng, messages, choose = np.random.default_rng(seed), [], sees_sides(sides)
    for seq in range(frames):
        for number, (name, camera) in enumerate(arena.truth.cameras.items()):
            t_ns = int((seq + phase * number) * period_ns)
            T = arena.wand_pose(1e-9 * t_ns)
            points, place = transform(T, CUBE.points), camera.matrix()[:3, 3] - T[:3, 3]
            chosen = choose(NORMALS @ T[:3, :3].T @ place / np.linalg.norm(place))
            uv = camera.project_world(points) + SIGMA_PX * rng.standard_normal((16, 2))
            shown = np.repeat(chosen, 4)
            messages.append(see_points(name, camera, uv, SIGMA_PX, shown, seq=seq, t_ns=t_ns))
    return messages


def one_after_the_other(groups: Sequence[int], frames: int, seed: int = 0) -> tuple[Arena, list[Detections]]:
    """A recording of an arena that is divided along x between groups of cameras: no two groups see the wand at once."""
    arena = ring(sum(groups), wand=CUBE, speed=3.0)
    group_of = dict(zip(arena.truth.cameras, np.repeat(np.arange(len(groups)), groups).tolist(), strict=True))
    edges = np.linspace(-0.5, 0.5, len(groups) + 1)[1:-1]
    messages = wave(arena, 2, frames, seed, period_ns=33_000_000, phase=0.24)
    place = {m.t_ns: arena.wand_pose(1e-9 * m.t_ns)[0, 3] for m in messages}
    return arena, [m for m in messages if group_of[m.camera] == np.searchsorted(edges, place[m.t_ns])]
