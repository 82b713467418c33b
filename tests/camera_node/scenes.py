# SPDX-License-Identifier: BSD-3-Clause
"""Small scenes for tests: a camera above a plain floor, and robots with positions given by the test."""

from pathlib import Path

import yaml

from camera_node.simulation.scene import Scene

LENS = {"width": 320, "height": 240, "fx": 300.0, "fy": 301.0, "cx": 158.3, "cy": 121.7}
CAMERA = LENS | {"position_m": [0.0, -0.6, 2.0], "look_at_m": [0.0, 0.0, 0.0], "noise": 0.0}
DISC = {"diameter_m": 0.2, "surround_ratio": 1.0, "inner_ratio": 0.1}  # nearly black: looks like one ellipse


def write_scene(folder: Path, robots: dict, motions: dict, cameras: dict | None = None, **fields) -> Path:
    """Write scene.yaml, wand.yaml and robots.yaml; the robots are visible from time 0 on."""
    plain = {"wand": "wand.yaml", "robots": "robots.yaml", "wave_s": 0.0, "wand_motion": {}, "clutter": False}
    scene = plain | {"cameras": cameras or {"cam0": CAMERA}, "robot_motions": motions} | fields
    (folder / "wand.yaml").write_text(
        yaml.safe_dump({"diameter_m": 0.1, "markers": [[0, 0, 0], [0.3, 0, 0]]})
    )
    (folder / "robots.yaml").write_text(yaml.safe_dump({"robots": robots}))
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
    return folder / "scene.yaml"


def load_disc(folder: Path, camera: dict | None = None, **motion) -> Scene:
    """A scene with the robot "disc", which moves by `motion`, in front of the camera "cam0"."""
    return Scene.load(
        write_scene(folder, {"disc": DISC}, {"disc": motion}, {"cam0": CAMERA | (camera or {})})
    )
