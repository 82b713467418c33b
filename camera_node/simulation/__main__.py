# SPDX-License-Identifier: BSD-3-Clause
"""`python -m camera_node.simulation`: renders a simulated arena into a folder."""

import math
from pathlib import Path
from typing import Annotated

import tyro

from camera_node.errors import ConfigError, run
from camera_node.simulation.recording import render_recording
from camera_node.simulation.scene import Scene


def main() -> None:
    """Render a simulated arena into a folder of frames, with its truth beside it."""
    run(lambda: tyro.cli(_render, prog="python -m camera_node.simulation"))


def _render(
    scene: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.Positional],
    start: float = 0.0,
    seconds: float = 10.0,
    cameras: tuple[str, ...] = (),
) -> None:
    """Render a simulated arena into OUT/<camera>/<t_ns>.png, with truth.json and a rig.yaml of intrinsics.

    Args:
        scene: the scene's YAML file, such as configs/demo/scene.yaml.
        out: the folder to write to; it is made where it is missing.
        start: first instant, seconds since the epoch. The wand is waved first, then the robots come.
        seconds: how long.
        cameras: render these cameras only.
    """
    if not (math.isfinite(start) and 0 < seconds < math.inf):
        raise ConfigError(f"--start {start} --seconds {seconds} is no span of time; give seconds above 0")
    render_recording(Scene.load(scene), out, start, start + seconds, cameras or None)
    print(f"{out}: frames by camera, truth.json, and rig.yaml with the intrinsics alone")


if __name__ == "__main__":
    main()
