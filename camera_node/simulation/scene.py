# SPDX-License-Identifier: BSD-3-Clause
"""Describes a simulated arena as a function of time: its cameras, first a moving wand, then moving robots."""

import math
from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.foundation.config import load_yaml
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.body import Body, PrintedWand, Vector
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import look_at, rotation_from_vector
from camera_node.simulation.sensor import SENSORS, Sensor, SensorName

CLEAN_VIGNETTING = 0.3
WAND = "wand"  # the name of the wand among the bodies


class Swing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sinusoidal coordinate: mean + amplitude sin(2 pi t / period_s + phase_deg)."""

    mean: float = 0.0
    amplitude: float = 0.0
    period_s: float = 10.0
    phase_deg: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mean) and math.isfinite(self.amplitude) and self.period_s > 0):
            raise ValueError("a swing needs a finite mean and amplitude, and a period above 0 s")

    def at(self, t_s: float) -> float:
        """The coordinate at `t_s`."""
        return self.mean + self.amplitude * math.sin(self._angle(t_s))

    def rate(self, t_s: float) -> float:
        """The derivative of the coordinate with respect to time, per second."""
        return self.amplitude * math.tau / self.period_s * math.cos(self._angle(t_s))

    def _angle(self, t_s: float) -> float:
        return math.tau * t_s / self.period_s + math.radians(self.phase_deg)


class SimulatedMotion(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The motion of a body: position of its origin (metres, world) and rotation (degrees: yaw, then pitch, then roll).

    Two swings a quarter period apart form a circle; with half the period in one of them, a figure eight. With
    `faces_travel`, the body's x axis points along its horizontal velocity, and `yaw_deg` is relative to that.
    """

    x_m: Swing = Swing()
    y_m: Swing = Swing()
    z_m: Swing = Swing()
    yaw_deg: Swing = Swing()
    pitch_deg: Swing = Swing()
    roll_deg: Swing = Swing()
    faces_travel: bool = False

    def pose(self, t_s: float) -> Array:
        """T_world_body (4, 4) at `t_s`."""
        yaw, pitch, roll = (math.radians(s.at(t_s)) for s in (self.yaw_deg, self.pitch_deg, self.roll_deg))
        if self.faces_travel:
            yaw += math.atan2(self.y_m.rate(t_s), self.x_m.rate(t_s))
        T = np.eye(4)
        T[:3, :3] = _rotation(2, yaw) @ _rotation(1, pitch) @ _rotation(0, roll)
        T[:3, 3] = [swing.at(t_s) for swing in (self.x_m, self.y_m, self.z_m)]
        return T


class SceneCamera(Lens, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A camera: its lens, pose, exposure times and image quality.

    Attributes:
        fps: frames per second; cameras are free-running, so each has its own rate and phase.
        phase_ms: time of the middle of the first exposure, after the epoch; with a rolling shutter of its middle row.
        exposure_us: exposure time.
        readout_us: time in which a rolling shutter reads all rows (`Detections`); 0 of a global shutter.
        motion_samples: number of times within an exposure whose images are averaged; 1 gives no motion blur.
        blur_px: standard deviation of the lens's blur, pixels.
        noise: standard deviation of a pixel's noise, grey levels of 255, of a clean sensor.
        sensor: "clean" (a machine-vision camera), "mild" (a good webcam: tone curve, shading, JPEG) or "harsh".
    """

    position_m: Vector
    look_at_m: Vector
    fps: float = 30.0
    phase_ms: float = 0.0
    exposure_us: float = 2000.0
    readout_us: float = 0.0
    motion_samples: int = 1
    blur_px: float = 0.7
    noise: float = 2.5
    sensor: SensorName = "clean"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (0.1 <= self.fps <= 1000 and 0 <= self.exposure_us <= 1e6 / self.fps):
            raise ValueError("fps must be in [0.1, 1000], and exposure_us no longer than a frame")
        if not abs(self.readout_us) <= 1e6 / self.fps:
            raise ValueError("readout_us must be no longer than a frame")
        if not (0.2 <= self.blur_px <= 5 and 0 <= self.noise <= 50 and 1 <= self.motion_samples <= 64):
            raise ValueError("blur_px must be in [0.2, 5], noise in [0, 50] and motion_samples in [1, 64]")
        look_at(self.position_m, self.look_at_m)

    @property
    def sensor_model(self) -> Sensor:
        """What the camera does to light; a clean one has `noise`, and 70 % of the light in the corners."""
        if self.sensor == "clean":
            return Sensor(vignetting=CLEAN_VIGNETTING, noise=self.noise)
        return SENSORS[self.sensor]

    @property
    def T_world_cam(self) -> Array:
        """(4, 4) pose of the camera."""
        return look_at(self.position_m, self.look_at_m)

    def exposure_middle_s(self, index: int) -> float:
        """Middle of the exposure `index`, seconds since the epoch."""
        return self.phase_ms * 1e-3 + index / self.fps

    def exposures(self, start_s: float, stop_s: float) -> range:
        """Indices of the exposures whose middle lies in [start_s, stop_s); indices start at 0."""
        first, end = (math.ceil((t - self.phase_ms * 1e-3) * self.fps - 1e-9) for t in (start_s, stop_s))
        return range(max(first, 0), max(end, 0))


class _Robot(Body, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A robot of the server's robots.yaml; the scene does not use the fields about tracking."""

    motion: object = None
    start_m: object = None


class _Robots(msgspec.Struct, forbid_unknown_fields=True):
    robots: dict[str, _Robot]


class _File(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A scene's YAML file; `wave_s` is the duration of the wand recording, and `clutter` adds marks to the floor."""

    wand: str
    robots: str
    wave_s: float
    cameras: dict[str, SceneCamera]
    wand_motion: SimulatedMotion
    robot_motions: dict[str, SimulatedMotion]
    seed: int = 0
    clutter: bool = True


class Scene:
    """The bodies in the arena and their poses at any time `t_s`, seconds since the epoch.

    While `t_s < wave_s` the arena contains the wand alone, afterwards the robots alone.
    """

    def __init__(self, file: _File, wand: Body, robots: Mapping[str, Body]) -> None:
        self.seed, self.clutter = file.seed, file.clutter
        self.wave_s, self.cameras = file.wave_s, file.cameras
        self.wand, self.robots = wand, robots
        self._wand_motion, self._motions = file.wand_motion, file.robot_motions

    @classmethod
    def load(cls, path: Path) -> "Scene":
        """Read a scene, and its wand and robots from the files that it names in the same folder.

        Raises:
            ConfigError: a file is missing, invalid or has an unknown key; a robot has no motion, or a motion no robot.
        """
        file = load_yaml(path, _File)
        wand = load_yaml(path.parent / file.wand, PrintedWand)
        robots = load_yaml(path.parent / file.robots, _Robots).robots
        if not file.cameras:
            raise ConfigError(f"{path} has no camera; add at least one under cameras")
        if odd := set(robots) ^ set(file.robot_motions):
            raise ConfigError(
                f"{path}: robot '{min(odd)}' needs an entry both in {file.robots} and under robot_motions"
            )
        if WAND in robots:
            raise ConfigError(f"{path.parent / file.robots}: '{WAND}' is the wand's name; rename the robot")
        return cls(file, wand, robots)

    def camera(self, name: str) -> SceneCamera:
        """The camera `name`; it is a `Lens`.

        Raises:
            ConfigError: the scene has no such camera.
        """
        if name not in self.cameras:
            raise ConfigError(f"the scene has no camera '{name}'; it has {', '.join(sorted(self.cameras))}")
        return self.cameras[name]

    def T_world_cam(self, name: str) -> Array:
        """(4, 4) true pose of the camera `name`."""
        return self.camera(name).T_world_cam

    def rig_entries(self) -> dict[str, dict]:
        """The intrinsics of each camera as plain values; `{"cameras": rig_entries()}` is a rig file without poses."""
        return {
            name: {field: getattr(camera, field) for field in Lens.__struct_fields__}
            | {"distortion": list(camera.distortion)}
            for name, camera in self.cameras.items()
        }

    def wand_pose(self, t_s: float) -> Array | None:
        """T_world_wand (4, 4), or None after the wand recording."""
        return self._wand_motion.pose(t_s) if t_s < self.wave_s else None

    def robot_pose(self, name: str, t_s: float) -> Array | None:
        """T_world_robot (4, 4), or None during the wand recording.

        Raises:
            ConfigError: the scene has no such robot.
        """
        if name not in self._motions:
            raise ConfigError(f"the scene has no robot '{name}'; it has {', '.join(sorted(self._motions))}")
        return None if t_s < self.wave_s else self._motions[name].pose(t_s)

    def bodies_at(self, t_s: float) -> dict[str, tuple[Body, Array]]:
        """The bodies in the arena with their T_world_body (4, 4), by name; the wand has the name "wand"."""
        if t_s < self.wave_s:
            return {WAND: (self.wand, self._wand_motion.pose(t_s))}
        return {name: (body, self._motions[name].pose(t_s)) for name, body in self.robots.items()}


def _rotation(axis: int, angle: float) -> Array:
    return rotation_from_vector(np.eye(3)[axis] * angle)
