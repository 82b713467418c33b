# SPDX-License-Identifier: BSD-3-Clause
"""A simulated arena as a pure function of time: cameras, a wand that is waved, then robots that drive and fly."""

import math
from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np

from camera_node.arrays import Array
from camera_node.config import load_yaml
from camera_node.errors import ConfigError
from camera_node.geometry.body import Body, Vector
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import look_at, rotation_from_vector

WAND = "wand"  # its name among the bodies


class Swing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One coordinate that swings: mean + amplitude sin(2 pi t / period_s + phase_deg)."""

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
        """Its derivative by time, per second."""
        return self.amplitude * math.tau / self.period_s * math.cos(self._angle(t_s))

    def _angle(self, t_s: float) -> float:
        return math.tau * t_s / self.period_s + math.radians(self.phase_deg)


class SimulatedMotion(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a body's origin goes (metres, world), and how the body turns (degrees: yaw, then pitch, then roll).

    Two swings a quarter period apart draw a circle, one of half the other's period a figure eight. With
    `faces_travel` the body's x axis points along its horizontal velocity, and `yaw_deg` adds to that.
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
        T[:3, :3] = _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)
        T[:3, 3] = [swing.at(t_s) for swing in (self.x_m, self.y_m, self.z_m)]
        return T


class SceneCamera(Lens, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A lens, where it stands and looks, when it exposes, and how good its image is.

    Attributes:
        fps: frames a second; cameras run free, so each has its own rate and phase.
        phase_ms: middle of the first exposure, after the epoch.
        exposure_us: how long the shutter is open.
        motion_samples: instants of one exposure that are averaged; 1 leaves the image without motion blur.
        blur_px: standard deviation of the lens's blur, pixels.
        noise: standard deviation of a pixel's noise, grey levels of 255.
    """

    position_m: Vector
    look_at_m: Vector
    fps: float = 30.0
    phase_ms: float = 0.0
    exposure_us: float = 2000.0
    motion_samples: int = 1
    blur_px: float = 0.7
    noise: float = 2.5

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (0.1 <= self.fps <= 1000 and 0 <= self.exposure_us <= 1e6 / self.fps):
            raise ValueError("fps must be in [0.1, 1000], and exposure_us no longer than a frame")
        if not (0.2 <= self.blur_px <= 5 and 0 <= self.noise <= 50 and 1 <= self.motion_samples <= 64):
            raise ValueError("blur_px must be in [0.2, 5], noise in [0, 50] and motion_samples in [1, 64]")
        look_at(self.position_m, self.look_at_m)

    @property
    def T_world_cam(self) -> Array:
        """(4, 4) pose of the camera."""
        return look_at(self.position_m, self.look_at_m)


class _Robot(Body, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The server's file is read here too; how a robot is tracked is not the scene's to judge."""

    motion: object = None
    start_m: object = None


class _Robots(msgspec.Struct, forbid_unknown_fields=True):
    robots: dict[str, _Robot]


class _File(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A scene's YAML file; without `clutter` the floor is plain grey."""

    wand: str
    robots: str
    wave_s: float
    cameras: dict[str, SceneCamera]
    wand_motion: SimulatedMotion
    robot_motions: dict[str, SimulatedMotion]
    seed: int = 0
    clutter: bool = True


class Scene:
    """What stands in the arena, and where it is at every time `t_s`, seconds since the epoch.

    While `t_s < wave_s` the wand is waved and no robot is there; after that the wand is gone.
    """

    def __init__(self, file: _File, wand: Body, robots: Mapping[str, Body]) -> None:
        self.seed, self.clutter = file.seed, file.clutter
        self.wave_s, self.cameras = file.wave_s, file.cameras
        self.wand, self.robots = wand, robots
        self._wand_motion, self._motions = file.wand_motion, file.robot_motions

    @classmethod
    def load(cls, path: Path) -> "Scene":
        """Read a scene, and the wand and robots that it names by files beside it.

        Raises:
            ConfigError: a file is missing, broken or has an unknown key; a robot has no motion, or the reverse.
        """
        file = load_yaml(path, _File)
        wand = load_yaml(path.parent / file.wand, Body)
        robots = load_yaml(path.parent / file.robots, _Robots).robots
        if not file.cameras:
            raise ConfigError(f"{path} names no camera; give at least one under cameras")
        if odd := set(robots) ^ set(file.robot_motions):
            raise ConfigError(
                f"{path}: robot '{min(odd)}' must stand both in {file.robots} and under robot_motions"
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
        """Each camera's intrinsics as plain values: `{"cameras": rig_entries()}` is a rig without poses."""
        return {
            name: {field: getattr(camera, field) for field in Lens.__struct_fields__}
            | {"distortion": list(camera.distortion)}
            for name, camera in self.cameras.items()
        }

    def wand_pose(self, t_s: float) -> Array | None:
        """T_world_wand (4, 4), or None when the wave is over."""
        return self._wand_motion.pose(t_s) if t_s < self.wave_s else None

    def robot_pose(self, name: str, t_s: float) -> Array | None:
        """T_world_robot (4, 4), or None while the wand is waved.

        Raises:
            ConfigError: the scene has no such robot.
        """
        if name not in self._motions:
            raise ConfigError(f"the scene has no robot '{name}'; it has {', '.join(sorted(self._motions))}")
        return None if t_s < self.wave_s else self._motions[name].pose(t_s)

    def robot_twist(self, name: str, t_s: float) -> tuple[Array, Array] | None:
        """Linear (3,) m/s and angular (3,) rad/s velocity of a robot in the world, or None while it is absent.

        Central differences over 1 ms: errors are of the order 1e-6 of the figures for motions of seconds.
        """
        if self.robot_pose(name, t_s) is None:
            return None
        h = 5e-4
        before, after = (self._motions[name].pose(t_s + dt) for dt in (-h, h))
        dR = after[:3, :3] @ before[:3, :3].T
        turn = np.array([dR[2, 1] - dR[1, 2], dR[0, 2] - dR[2, 0], dR[1, 0] - dR[0, 1]]) / 2
        return (after[:3, 3] - before[:3, 3]) / (2 * h), turn / (2 * h)

    def bodies_at(self, t_s: float) -> dict[str, tuple[Body, Array]]:
        """Every body in the arena by name, the wand under "wand", with its T_world_body (4, 4)."""
        if t_s < self.wave_s:
            return {WAND: (self.wand, self._wand_motion.pose(t_s))}
        return {name: (body, self._motions[name].pose(t_s)) for name, body in self.robots.items()}


def _turn(axis: int, angle: float) -> Array:
    return rotation_from_vector(np.eye(3)[axis] * angle)
