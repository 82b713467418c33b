# SPDX-License-Identifier: BSD-3-Clause
"""Frames of a simulated camera: in real time as a source, or as a recording of all cameras with the true poses."""

import json
import math
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import msgspec

from camera_node.foundation.config import write_atomically
from camera_node.foundation.errors import CameraError, ConfigError
from camera_node.foundation.terminal import track
from camera_node.geometry.pose import invert
from camera_node.simulation.renderer import Renderer
from camera_node.simulation.scene import WAND, Scene, SceneCamera
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


def render_recording(
    scene: Scene,
    folder: Path,
    start_s: float,
    stop_s: float,
    cameras: Sequence[str] | None = None,
    epoch_ns: int = 0,
) -> None:
    """Write `<folder>/<camera>/<t_ns>.png` for every exposure in [start_s, stop_s), seconds since `epoch_ns`.

    Also writes `truth.json`, and `rig.yaml` with the intrinsics alone, from which a calibration starts.

    Raises:
        ConfigError: the scene lacks one of the cameras, or the folder can't be written to.
        CameraError: a frame can't be written.
    """
    names = list(scene.cameras) if cameras is None else list(cameras)
    exposures = {name: scene.camera(name).exposures(start_s, stop_s) for name in names}
    for name in names:
        _make_folder(folder / name)
    write_atomically(folder / "truth.json", json.dumps(describe_truth(scene, exposures, epoch_ns), indent=1))
    entries = {name: entry for name, entry in scene.rig_entries().items() if name in names}
    write_atomically(folder / "rig.yaml", msgspec.yaml.encode({"cameras": entries}).decode())
    for name, indices in exposures.items():
        renderer = Renderer(scene, name)
        for index in track(indices, f"rendering {name}"):
            t_s = scene.camera(name).exposure_middle_s(index)
            path = folder / name / f"{epoch_ns + round(t_s * 1e9):015d}.png"
            if not cv2.imwrite(str(path), renderer.render(t_s, index), [cv2.IMWRITE_PNG_COMPRESSION, 1]):
                raise CameraError(f"{path} can't be written; check the free space on the disk")


def describe_truth(scene: Scene, exposures: dict[str, range], epoch_ns: int) -> dict:
    """The truth of a recording: cameras, bodies, and poses at the stamps of the first camera.

    Matrices are (4, 4), and times are Unix seconds. `outer_diameter_m` of the robots is the smallest of them.
    """
    first = scene.camera(next(iter(exposures)))
    poses: dict[str, list] = {body: [] for body in (WAND, *scene.robots)}
    for index in next(iter(exposures.values())):
        t_s = first.exposure_middle_s(index)
        for body, (_, T) in scene.bodies_at(t_s).items():
            poses[body].append([epoch_ns * 1e-9 + t_s, T.tolist()])
    return {
        "cameras": {name: _describe_camera(scene.camera(name)) for name in exposures},
        "wand": {
            "markers_m": scene.wand.markers,
            "outer_diameter_m": scene.wand.diameter_m,
            "poses": poses.pop(WAND),
        },
        "robots": {
            "outer_diameter_m": min((body.diameter_m for body in scene.robots.values()), default=None),
            "markers_m": {robot: body.markers for robot, body in scene.robots.items()},
            "normals": {robot: body.unit_normals.tolist() for robot, body in scene.robots.items()},
            "poses_at_stamps_of_cam0": poses,
        },
    }


def _describe_camera(camera: SceneCamera) -> dict:
    return {
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "dist": camera.distortion,
        "T_cam_world": invert(camera.T_world_cam).tolist(),
        "fps": camera.fps,
        "phase_ms": camera.phase_ms,
        "readout_us": camera.readout_us,
    }


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder} can't be created: {error.strerror}; choose another folder") from None
