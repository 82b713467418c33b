# SPDX-License-Identifier: BSD-3-Clause
"""Predicts range, coverage and precision of planned cameras, before they are mounted.

The sensor model is that of Faigl, Krajnik, Chudoba and Saska (ICRA 2013): a roundel of diameter d_o is detected from
v_min = d_o max(f_x / w, f_y / h), where it fills the image, to v_max = d_o / D min(f_x cos phi, f_y cos psi), where its
minor axis is D pixels. At v_max the operational space is v_max w / f_x - 2 d_o wide and v_max h / f_y - 2 d_o high.
The paper prints the last two fractions inverted; as given here they are lengths.
"""

from dataclasses import dataclass, replace

import msgspec
import numpy as np

from calib.rig.camera import Camera
from calib.rig.precision_map import SIGMA_PX, FloorGrid, PrecisionMap, map_precision
from camera_node.arrays import Array, Mask
from camera_node.geometry.pose import Pose, look_at

Vector = tuple[float, float, float]


class PlannedCamera(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A camera that is not mounted yet, with a lens given by its field of view or by its focal length.

    Attributes:
        width, height: of its image, pixels.
        fov_deg: horizontal field of view without distortion, as in data sheets.
        focal_px: focal length, pixels; instead of `fov_deg`.
        position_m, look_at_m: its position, and the point in the middle of its image, world.
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
            raise ValueError("look_at_m equals position_m; give another point")
        self.camera()

    def camera(self) -> Camera:
        """The camera at its planned pose, which counts as exact."""
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
    """A planned arena, as in `configs/plan.yaml`.

    Attributes:
        area_m: x0, y0, x1, y1 of the floor.
        height_m: of the level roundels that robots carry.
        diameter_m: of these roundels.
        min_diameter_px: the smallest minor axis at which the detector finds a roundel.
        sigma_px: standard deviation of one coordinate of its centre.
        cameras: by name.
    """

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

    def grid(self) -> FloorGrid:
        """The points for which errors are predicted."""
        return FloorGrid.covering(self.area_m[:2], self.area_m[2:], self.height_m)


@dataclass(frozen=True, slots=True)
class SensorRange:
    """The range in which one camera detects roundels.

    Attributes:
        v_min, v_max: nearest and farthest distance, metres.
        v_y, v_z: width and height of the operational space at v_max, metres.
        share: fraction of the area that the camera sees.
    """

    v_min: float
    v_max: float
    v_y: float
    v_z: float
    share: float


@dataclass(frozen=True, slots=True)
class PlanReport:
    """The evaluation of a plan: the range of each camera by name, and the map of expected errors."""

    ranges: dict[str, SensorRange]
    precision: PrecisionMap


def sensor_range(camera: Camera, diameter_m: float, min_diameter_px: float, tilt_rad: float) -> SensorRange:
    """The paper's model of one camera, for roundels tilted by `tilt_rad` about either axis; `share` is 0."""
    w, h, f_x, f_y = camera.width, camera.height, camera.fx, camera.fy
    v_min = diameter_m * max(f_x / w, f_y / h)
    v_max = diameter_m / min_diameter_px * min(f_x, f_y) * float(np.cos(tilt_rad))
    return SensorRange(v_min, v_max, v_max * w / f_x - 2 * diameter_m, v_max * h / f_y - 2 * diameter_m, 0.0)


def sees_level(camera: Camera, points: Array, diameter_m: float, min_diameter_px: float) -> Mask:
    """(N,) whether a camera detects level roundels at points (N, 3), world: from above, complete, and large enough.

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


def evaluate_plan(plan: Plan) -> PlanReport:
    """Predict range, coverage and errors. Poses count as exact; a good calibration adds less than 5 % to the errors."""
    cameras = {name: entry.camera() for name, entry in plan.cameras.items()}

    def sees(camera: Camera, points: Array) -> Mask:
        return sees_level(camera, points, plan.diameter_m, plan.min_diameter_px)

    precision = map_precision(list(cameras.values()), plan.grid(), plan.sigma_px, sees=sees)
    ranges = {}
    for name, camera in cameras.items():
        tilt = float(np.arccos(np.clip(-camera.matrix()[2, 2], -1, 1)))
        reach = sensor_range(camera, plan.diameter_m, plan.min_diameter_px, tilt)
        ranges[name] = replace(reach, share=float(sees(camera, plan.grid().points).mean()))
    return PlanReport(ranges, precision)
