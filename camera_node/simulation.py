# SPDX-License-Identifier: BSD-3-Clause
"""Simulated cameras: live ones that free-run in real time, and recordings with their truth beside them."""

import json
import math
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import tyro
from rich.progress import track

from camera_node.config import write_atomically
from camera_node.errors import CameraError, ConfigError, run
from camera_node.frame import Frame
from camera_node.pose import invert
from camera_node.rendering import Renderer
from camera_node.scene import WAND, Scene, SceneCamera


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


def render_recording(
    scene: Scene,
    folder: Path,
    start_s: float,
    stop_s: float,
    cameras: Sequence[str] | None = None,
    epoch_ns: int = 0,
) -> None:
    """Write `<folder>/<camera>/<t_ns>.png` for every exposure from `start_s` until before `stop_s`.

    Beside them go `truth.json` and `rig.yaml`, which holds the intrinsics alone: what a calibration starts from.

    Raises:
        ConfigError: the scene lacks one of the cameras, or the folder can't be written to.
    """
    names = list(scene.cameras) if cameras is None else list(cameras)
    exposures = {name: list_exposures(scene.camera(name), start_s, stop_s) for name in names}
    for name in names:
        try:
            (folder / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(
                f"{folder / name} can't be made: {error.strerror}; choose another folder"
            ) from None
    write_atomically(folder / "truth.json", json.dumps(describe_truth(scene, exposures, epoch_ns), indent=1))
    entries = {name: entry for name, entry in scene.rig_entries().items() if name in names}
    write_atomically(folder / "rig.yaml", msgspec.yaml.encode({"cameras": entries}).decode())
    for name, indices in exposures.items():
        renderer = Renderer(scene, name)
        for index in track(indices, f"rendering {name}", transient=True):
            t_s = exposure_middle_s(scene.camera(name), index)
            path = folder / name / f"{epoch_ns + round(t_s * 1e9):015d}.png"
            if not cv2.imwrite(str(path), renderer.render(t_s, index), [cv2.IMWRITE_PNG_COMPRESSION, 1]):
                raise CameraError(f"{path} can't be written: is the disk full?")


def list_exposures(camera: SceneCamera, start_s: float, stop_s: float) -> range:
    """Indices of a camera's exposures whose middle lies in [start_s, stop_s); none before its first."""
    first, end = (math.ceil((t - camera.phase_ms * 1e-3) * camera.fps - 1e-9) for t in (start_s, stop_s))
    return range(max(first, 0), max(end, 0))


def describe_truth(scene: Scene, exposures: dict[str, range], epoch_ns: int) -> dict:
    """What is true of a recording: cameras, bodies, and their poses at the stamps of the first camera.

    Matrices are (4, 4) and times Unix seconds. `outer_diameter_m` of the robots is that of the smallest.
    """
    name = next(iter(exposures))
    times = [exposure_middle_s(scene.camera(name), index) for index in exposures[name]]
    poses: dict[str, list] = {body: [] for body in (WAND, *scene.robots)}
    for t_s in times:
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
    }


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
