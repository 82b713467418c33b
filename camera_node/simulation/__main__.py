# SPDX-License-Identifier: BSD-3-Clause
"""`python -m camera_node.simulation`: renders a simulated recording into a folder."""

import math
import sys
from pathlib import Path
from typing import Annotated

import tyro

from camera_node.foundation.command_line import run_command
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.program import run
from camera_node.simulation.scene import Scene
from camera_node.simulation.simulated_camera import render_recording


def main() -> None:
    """The entry point of the command."""
    run(lambda: run_command(simulate, "roundel simulate", sys.argv[1:]))


def simulate(
    scene: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.Positional],
    start: float = 0.0,
    seconds: float = 10.0,
    cameras: tuple[str, ...] = (),
) -> None:
    """Render a simulated arena into OUT/<camera>/<t_ns>.png, with truth.json and a rig.yaml of intrinsics.

    Args:
        scene: the scene's YAML file, such as configs/demo/scene.yaml.
        out: the folder to write to; it is created if necessary.
        start: time of the beginning, seconds since the epoch. The wand moves first, the robots after it.
        seconds: duration of the recording.
        cameras: the cameras to render; all unless given.
    """
    if not (math.isfinite(start) and 0 < seconds < math.inf):
        raise ConfigError(f"--start {start} --seconds {seconds} is not a time span; give seconds above 0")
    render_recording(Scene.load(scene), out, start, start + seconds, cameras or None)
    print(f"{out}: frames of each camera, truth.json, and rig.yaml with the intrinsics")


if __name__ == "__main__":
    main()
