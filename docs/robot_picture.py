# SPDX-License-Identifier: BSD-3-Clause
"""Draws the picture of docs/robots.md: `python docs/robot_picture.py`. Three views of the cube of `configs/cube`."""

from pathlib import Path

import cv2
import msgspec
import numpy as np

from camera_node.foundation.config import example_file
from camera_node.simulation.renderer import Renderer
from camera_node.simulation.scene import Scene

TIMES_S = (16.0, 17.5, 19.0)
CAMERA = "south"


def main() -> None:
    """Write the picture beside this file."""
    scene = Scene.load(example_file("cube/scene.yaml"))
    pictures = []
    for t_s in TIMES_S:
        cube = scene.robot_pose("cube", t_s)
        assert cube is not None
        close = {"position_m": (0.6, -1.1, 1.4), "look_at_m": tuple(cube[:3, 3].tolist())}
        lens = {"width": 260, "height": 240, "cx": 130.0, "cy": 120.0, "fx": 420.0, "fy": 420.0}
        camera = msgspec.structs.replace(scene.cameras[CAMERA], sensor="clean", **close, **lens)
        scene.cameras[CAMERA] = camera
        pictures.append(Renderer(scene, CAMERA).render(t_s))
    cv2.imwrite(str(Path(__file__).parent / "robots_cube.jpg"), np.hstack(pictures))


if __name__ == "__main__":
    main()
