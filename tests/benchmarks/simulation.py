# SPDX-License-Identifier: BSD-3-Clause
"""Processor time of rendering a frame, in one thread: `python -m tests.benchmarks.simulation [SCENE]`."""

import sys
import time
from pathlib import Path

import numpy as np

from camera_node.simulation.renderer import Renderer
from camera_node.simulation.scene import Scene

DEMO = Path(__file__).resolve().parents[2] / "configs" / "demo" / "scene.yaml"
FRAMES = 200


def main(path: Path) -> None:
    """Print the start-up time and the time for each frame of every camera, with the wand and with the robots."""
    scene = Scene.load(path)
    for name in scene.cameras:
        start = time.process_time()
        renderer = Renderer(scene, name)
        print(f"{name}: start-up {time.process_time() - start:.2f} s", end="")
        for body, first_s in (("wand", 0.0), ("robots", scene.wave_s)):
            times = np.linspace(first_s, first_s + min(scene.wave_s, 15.0) * 0.99, FRAMES)
            start = time.process_time()
            for k, t_s in enumerate(times):
                renderer.render(float(t_s), k)
            print(f"; {body} {(time.process_time() - start) / FRAMES * 1e3:.2f} ms per frame", end="")
        print()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else DEMO)
