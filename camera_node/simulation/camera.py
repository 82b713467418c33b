# SPDX-License-Identifier: BSD-3-Clause
"""A simulated camera: it runs freely, in real time, at its own rate and phase."""

import math
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from camera_node.simulation.renderer import Renderer
from camera_node.simulation.scene import Scene, SceneCamera
from camera_node.sources.frame import Frame


class SimulatedCamera:
    """A camera of a scene in real time: free-running, at its own rate and phase, and never behind.

    Who is slower than the camera gets the newest exposure next; `dropped` counts those that were passed over.
    """

    def __init__(self, scene_path: Path, name: str, epoch_ns: int) -> None:
        """Prepare the camera `name`; the scene's time 0 is `epoch_ns`, Unix time.

        Raises:
            ConfigError: the scene is missing or broken, or has no such camera.
        """
        scene = Scene.load(scene_path)
        self._renderer, self._camera = Renderer(scene, name), scene.camera(name)
        self._epoch_ns = epoch_ns
        self._closed = threading.Event()
        self.dropped = 0

    def __iter__(self) -> Iterator[Frame]:
        """Frames from now on until `close`, each as soon as its exposure has ended."""
        index = self._newest() + 1
        while self._wait_until(self._end_ns(index)):
            t_s = exposure_middle_s(self._camera, index)
            image = self._renderer.render(t_s, index)
            yield Frame(image, self._epoch_ns + round(t_s * 1e9), self._camera.exposure_us)
            newest = self._newest()
            self.dropped += max(0, newest - index - 1)
            index = max(index + 1, newest)

    def close(self) -> None:
        """End the iteration, from any thread."""
        self._closed.set()

    def _newest(self) -> int:
        """The index of the last exposure that has ended by now; -1 before the first."""
        ago_s = (time.time_ns() - self._end_ns(0)) * 1e-9
        return max(-1, math.floor(ago_s * self._camera.fps))

    def _end_ns(self, index: int) -> int:
        t_s = exposure_middle_s(self._camera, index) + self._camera.exposure_us * 0.5e-6
        return self._epoch_ns + round(t_s * 1e9)

    def _wait_until(self, t_ns: int) -> bool:
        """Whether that time came before the camera was closed."""
        while (left_ns := t_ns - time.time_ns()) > 0:
            if self._closed.wait(min(left_ns * 1e-9, 1.0)):
                return False
        return not self._closed.is_set()


def exposure_middle_s(camera: SceneCamera, index: int) -> float:
    """Middle of the exposure `index`, seconds since the epoch."""
    return camera.phase_ms * 1e-3 + index / camera.fps
