# SPDX-License-Identifier: BSD-3-Clause
"""A simulated camera: a source of rendered frames in real time."""

import math
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from camera_node.simulation.renderer import Renderer
from camera_node.simulation.scene import Scene
from camera_node.sources.frame import Frame, Source


class SimulatedCamera(Source):
    """A free-running camera of a scene, in real time.

    A reader that is slower than the camera gets the newest exposure next; `dropped` counts the skipped ones.
    """

    def __init__(self, scene_path: Path, name: str, epoch_ns: int) -> None:
        """Load the scene and prepare the camera `name`; `epoch_ns` is the Unix time of the scene's time 0.

        Raises:
            ConfigError: the scene is missing or invalid, or has no such camera.
        """
        scene = Scene.load(scene_path)
        self.dropped = 0
        self._renderer, self._camera = Renderer(scene, name), scene.camera(name)
        self._epoch_ns = epoch_ns
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames from now on until `close`, each as soon as its exposure has ended."""
        index = self._newest() + 1
        while self._wait_until(self._end_ns(index)):
            t_s = self._camera.exposure_middle_s(index)
            image = self._renderer.render(t_s, index)
            camera = self._camera
            yield Frame(
                image, self._epoch_ns + round(t_s * 1e9), camera.exposure_us, readout_us=camera.readout_us
            )
            newest = self._newest()
            self.dropped += max(0, newest - index - 1)
            index = max(index + 1, newest)

    def close(self) -> None:
        """End the iteration, from any thread."""
        self._closed.set()

    def _newest(self) -> int:
        """The index of the last exposure that has ended; -1 before the first."""
        elapsed_s = (time.time_ns() - self._end_ns(0)) * 1e-9
        return max(-1, math.floor(elapsed_s * self._camera.fps))

    def _end_ns(self, index: int) -> int:
        camera = self._camera
        t_s = camera.exposure_middle_s(index) + (camera.exposure_us + abs(camera.readout_us)) * 0.5e-6
        return self._epoch_ns + round(t_s * 1e9)

    def _wait_until(self, t_ns: int) -> bool:
        """Wait until that time or until the camera is closed; return whether it is still open."""
        while (left_ns := t_ns - time.time_ns()) > 0:
            if self._closed.wait(min(left_ns * 1e-9, 1.0)):
                return False
        return not self._closed.is_set()
