# SPDX-License-Identifier: BSD-3-Clause
"""What cameras would see and know of an arena, before a hole is drilled.

The sensor model of Faigl, Krajnik, Chudoba and Saska (ICRA 2013): a roundel of diameter d_o is detected from
v_min = d_o max(f_x / w, f_y / h), where it fills the image, to v_max = d_o / D min(f_x cos phi, f_y cos psi), where its
minor axis is D pixels; at v_max the operational space is v_max w / f_x - 2 d_o wide and v_max h / f_y - 2 d_o high.
(The paper prints these two fractions upside down; only so are they lengths.)
"""

from dataclasses import dataclass, replace

import msgspec
import numpy as np

from calib.plan.precision import SIGMA_PX, PrecisionMap, map_precision
from calib.rig.camera import Camera
from camera_node.arrays import Array, Mask
from camera_node.geometry.pose import Pose, look_at

Vector = tuple[float, float, float]


class PlannedCamera(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A camera that may be bought and mounted: its lens by the horizontal field of view, or by a focal length.

    Attributes:
        width, height: of its image, pixels.
        fov_deg: horizontal field of view without distortion, as data sheets have it.
        focal_px: focal length, pixels; instead of `fov_deg`.
        position_m, look_at_m: where it stands and what is in the middle of its image.
    """

    width: int
    height: int
    fov_deg: float | None = None
    focal_px: float | None = None
    position_m: Vector
    look_at_m: Vector

    def __post_init__(self) -> None:
        if (self.fov_deg is None) == (self.focal_px is None):
            raise ValueError("give one of fov_deg and focal_px")
        if self.fov_deg is not None and not 1 < self.fov_deg < 170:
            raise ValueError(f"fov_deg is {self.fov_deg}; give 1 to 170 degrees")
        if np.allclose(self.position_m, self.look_at_m):
            raise ValueError("look_at_m must be another place than position_m")
        self.camera()

    def camera(self) -> Camera:
        """The camera, where it would stand; its pose is exact."""
        focal = self.focal_px or 0.0
        if self.fov_deg is not None:
            focal = self.width / 2 / np.tan(np.radians(self.fov_deg) / 2)
        return Camera(
            width=self.width,
            height=self.height,
            fx=float(focal),
            fy=float(focal),
            cx=(self.width - 1) / 2,
            cy=(self.height - 1) / 2,
            T_world_cam=Pose.from_matrix(look_at(self.position_m, self.look_at_m)),
        )


class Plan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An arena to be: the floor from `area_m` x0, y0 to x1, y1; robots carry roundels of `diameter_m`, level, at
    `height_m`; a roundel is found from `min_diameter_px` across its minor axis, its centre to `sigma_px`."""

    area_m: tuple[float, float, float, float]
    height_m: float = 0.1
    diameter_m: float
    min_diameter_px: float = 11.0
    sigma_px: float = SIGMA_PX
    cameras: dict[str, PlannedCamera]

    def __post_init__(self) -> None:
        x0, y0, x1, y1 = self.area_m
        if not (x0 < x1 and y0 < y1):
            raise ValueError("area_m must be [x0, y0, x1, y1] with x0 < x1 and y0 < y1, metres")
        if not (self.diameter_m > 0 and self.min_diameter_px > 0 and self.sigma_px > 0):
            raise ValueError("diameter_m, min_diameter_px and sigma_px must be above 0")
        if not self.cameras:
            raise ValueError("cameras must name one or more")


@dataclass(frozen=True, slots=True)
class Range:
    """Where one camera sees roundels: nearest and farthest distance, size of the operational space at the far end (all
    metres), and the part of the area that it sees."""

    v_min: float
    v_max: float
    v_y: float
    v_z: float
    share: float


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a plan comes to: a range by camera, and the map of expected errors."""

    ranges: dict[str, Range]
    expected: PrecisionMap


def sensor_range(camera: Camera, diameter_m: float, min_diameter_px: float, tilt_rad: float) -> Range:
    """The paper's model of one camera, for roundels that are tilted by `tilt_rad` about either axis; share is 0."""
    w, h, f_x, f_y = camera.width, camera.height, camera.fx, camera.fy
    v_min = diameter_m * max(f_x / w, f_y / h)
    v_max = diameter_m / min_diameter_px * min(f_x, f_y) * float(np.cos(tilt_rad))
    return Range(v_min, v_max, v_max * w / f_x - 2 * diameter_m, v_max * h / f_y - 2 * diameter_m, 0.0)


def sees_level(camera: Camera, points: Array, diameter_m: float, min_diameter_px: float) -> Mask:
    """Which of the points (N, 3) a camera above sees as level roundels, wholly and not too small.

    A level disc seen under the angle phi from the vertical, at distance r, has a minor axis of about f d_o cos phi / r.
    """
    T = camera.matrix()
    away = T[:3, 3] - points
    distance = np.linalg.norm(away, axis=1)
    minor = min(camera.fx, camera.fy) * diameter_m * away[:, 2] / distance**2
    edges = [
        points + diameter_m / 2 * np.array(step) for step in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))
    ]
    inside = np.logical_and.reduce([camera.sees(camera.project_world(edge)) for edge in edges])
    return inside & (minor >= min_diameter_px)


def foresee(plan: Plan) -> Forecast:
    """Range, coverage and expected errors of a plan; poses count as known (a good calibration adds less than 5 %)."""
    cameras = {name: entry.camera() for name, entry in plan.cameras.items()}
    low, high = np.array(plan.area_m[:2]), np.array(plan.area_m[2:])

    def seen(camera: Camera, points: Array) -> Mask:
        return sees_level(camera, points, plan.diameter_m, plan.min_diameter_px)

    expected = map_precision(list(cameras.values()), low, high, plan.height_m, plan.sigma_px, sees=seen)
    grid = expected.points
    ranges = {}
    for name, camera in cameras.items():
        tilt = float(np.arccos(np.clip(-camera.matrix()[2, 2], -1, 1)))
        told = sensor_range(camera, plan.diameter_m, plan.min_diameter_px, tilt)
        ranges[name] = replace(told, share=float(seen(camera, grid).mean()))
    return Forecast(ranges, expected)
