# SPDX-License-Identifier: BSD-3-Clause
"""The simulated arena that the planner's predictions are compared with."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calib.plan.camera_kind import CameraKind
from calib.plan.description import ImageQuality, Plan, PlannedRobots
from calib.plan.planner import PlannedArena
from calib.rig.camera import Camera
from camera_node.foundation.arrays import Array
from camera_node.simulation.renderer import BLACK, WHITE
from camera_node.simulation.scene import Scene

FPS, EXPOSURE_US, BLUR_PX, NOISE = 30.0, 500.0, 0.7, 2.5
KIND = CameraKind(model="ov9281", fps=FPS, exposure_us=EXPOSURE_US)
HALF_M, HEIGHTS_M, CEILING_M = 1.6, (0.1, 0.9), 2.8
RING_M = 2.0  # of the cameras around the arena
DIAMETER_M = 0.12
SMALL_M = 0.045  # of roundels whose size and slant limit the range before the image's border does


def planned_arena(diameter_m: float = DIAMETER_M) -> PlannedArena:
    """Four cameras around an arena, with the simulator's image quality and even floor, and roundels of this diameter.

    Limits of size and slant are those of half of the roundels: the others are found farther or less far away.
    """
    angles = np.radians([45, 135, 225, 315])
    places = [(RING_M * np.cos(a), RING_M * np.sin(a), CEILING_M) for a in angles]
    cameras = {f"c{k}": KIND.placed(place, (0.0, 0.0, 0.3)) for k, place in enumerate(places)}
    robots = PlannedRobots(diameter_m=diameter_m, heights_m=HEIGHTS_M, speed_m_s=0.0)
    image = ImageQuality(
        blur_px=BLUR_PX, noise=NOISE, contrast=mean_contrast(), sigma_px=0.0, ground="even", found_share=0.5
    )
    plan = Plan(area_m=(-HALF_M, -HALF_M, HALF_M, HALF_M), ceiling_m=CEILING_M, robots=robots, image=image)
    return PlannedArena.of_cameras(plan, cameras, KIND)


def mean_contrast() -> float:
    """Of print in the simulator's pictures, grey levels, in the mean over the picture."""
    return (WHITE - BLACK) * (1 - 0.3 / 3)  # the corners lose 30 %: `CLEAN_VIGNETTING`


def write_scene(
    folder: Path, cameras: Mapping[str, Camera], motions: Mapping[str, Any], diameter_m: float = DIAMETER_M
) -> Scene:
    """A scene with single roundels that move, seen by cameras; JSON is YAML too."""
    body = {"diameter_m": diameter_m}
    entries = {}
    for name, camera in cameras.items():
        T = camera.matrix()
        entries[name] = {
            **{field: getattr(camera, field) for field in ("width", "height", "fx", "fy", "cx", "cy")},
            "position_m": T[:3, 3].tolist(),
            "look_at_m": (T[:3, 3] + T[:3, 2]).tolist(),
            "fps": FPS,
            "exposure_us": EXPOSURE_US,
            "blur_px": BLUR_PX,
            "noise": NOISE,
        }
    wand = {**body, "markers": [[0, 0, 0], [0.3, 0, 0]]}
    scene = {
        "wand": "wand.yaml",
        "robots": "robots.yaml",
        "wave_s": 1e-3,
        "cameras": entries,
        "wand_motion": {"z_m": {"mean": -5.0}},
        "robot_motions": motions,
        "clutter": False,
    }
    files = {"wand": wand, "robots": {"robots": dict.fromkeys(motions, body)}, "scene": scene}
    for name, content in files.items():
        (folder / f"{name}.yaml").write_text(json.dumps(content, default=float))
    return Scene.load(folder / "scene.yaml")


def image_of(camera: Camera, places: Array, diameter_m: float = DIAMETER_M) -> tuple[Array, Array]:
    """Pixels (N, 2) and radii (N,) of the discs at places (N, 3)."""
    depth = (places - camera.matrix()[:3, 3]) @ camera.matrix()[:3, 2]
    return camera.project_world(places), camera.fx * diameter_m / 2 / depth
