# SPDX-License-Identifier: BSD-3-Clause
"""Renders a simulated recording: the frames of all cameras, and the true poses."""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import msgspec

from camera_node.foundation.config import write_atomically
from camera_node.foundation.errors import CameraError, ConfigError
from camera_node.foundation.terminal import track
from camera_node.geometry.pose import invert
from camera_node.simulation.renderer import Renderer
from camera_node.simulation.scene import WAND, Scene, SceneCamera


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
