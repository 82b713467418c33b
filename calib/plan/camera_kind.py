# SPDX-License-Identifier: BSD-3-Clause
"""A kind of camera: sensor, lens, rate and exposure, of the catalogue or as described; and a camera at its place."""

from typing import Literal

import msgspec
import numpy as np

from calib.plan.catalogue import find_camera
from calib.rig.camera import Camera
from camera_node.foundation.arrays import Array
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import Pose, look_at

Vector = tuple[float, float, float]
STAMP_SIGMA_S = 1e-4  # of a global shutter whose clock is synchronized over the network
# Of a rolling shutter's readout time after a wand calibration: `python -m tests.benchmarks.rolling_shutter`.
READOUT_SIGMA_S = 0.4e-3
VERTICAL = 1e-4  # rad; an axis nearer to the vertical leaves the rotation about it undefined
PINHOLE_FOV_DEG, FISHEYE_FOV_DEG = (1.0, 170.0), (1.0, 178.0)


class CameraKind(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A kind of camera: of the catalogue, or by its image's size and its lens.

    Attributes:
        model: its name in the catalogue; the other fields replace the catalogue's figures.
        focal_mm: of another lens on a camera of the catalogue.
        width, height: of its image, pixels.
        fov_deg: horizontal field of view without distortion, as in data sheets.
        focal_px: focal length, pixels; instead of `fov_deg`.
        lens: "fisheye" for a lens whose image height grows with the angle.
        fps: frames per second.
        exposure_us: exposure time; None for a thousandth of a second or less, if the frame rate requires it.
        shutter: "rolling" for cameras that read the rows one after another.
        stamp_sigma_ms: standard deviation of the capture times, of the clock and of a rolling shutter's rows.
    """

    model: str | None = None
    focal_mm: float | None = None
    width: int | None = None
    height: int | None = None
    fov_deg: float | None = None
    focal_px: float | None = None
    lens: Literal["pinhole", "fisheye"] | None = None
    fps: float | None = None
    exposure_us: float = 1000.0
    shutter: Literal["global", "rolling"] | None = None
    stamp_sigma_ms: float | None = None

    def __post_init__(self) -> None:
        given = [self.fov_deg is not None, self.focal_px is not None, self.focal_mm is not None]
        if sum(given) > 1 or (self.model is None and not (given[0] or given[1])):
            raise ValueError("give one of fov_deg and focal_px, or a model of the catalogue")
        if self.model is None and (self.width is None or self.height is None):
            raise ValueError("give width and height in pixels, or a model of the catalogue")
        self._check_lens()
        if self.fps is not None and not 0.1 <= self.fps <= 1000:
            raise ValueError(f"fps is {self.fps}; give 0.1 to 1000")
        if not 0 < self.exposure_us <= 1e6:
            raise ValueError(f"exposure_us is {self.exposure_us}; give 1 to 1e6")
        if self.stamp_sigma_ms is not None and not 0 <= self.stamp_sigma_ms <= 1000:
            raise ValueError(f"stamp_sigma_ms is {self.stamp_sigma_ms}; give 0 to 1000")

    def _check_lens(self) -> None:
        if self.model is not None:
            try:
                entry = find_camera(self.model)
            except ConfigError as error:
                raise ValueError(str(error)) from None
            if self.focal_mm is not None and not (entry.changeable and 0.5 <= self.focal_mm <= 200):
                raise ValueError(
                    f"focal_mm is {self.focal_mm}; give 0.5 to 200 mm"
                    if entry.changeable
                    else f"the lens of '{self.model}' can't be changed; leave focal_mm out"
                )
        low, high = FISHEYE_FOV_DEG if self.lens == "fisheye" else PINHOLE_FOV_DEG
        if self.fov_deg is not None and not low < self.fov_deg < high:
            raise ValueError(f"fov_deg is {self.fov_deg}; give {low:g} to {high:g} degrees")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image, pixels."""
        if self.model is None:
            return self.width or 0, self.height or 0  # `__post_init__` requires both
        entry = find_camera(self.model)
        return self.width or entry.width, self.height or entry.height

    @property
    def projection(self) -> Literal["pinhole", "fisheye"]:
        """The projection of the lens."""
        return self.lens or (find_camera(self.model).model if self.model else "pinhole")

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        if self.focal_px is not None:
            return self.focal_px
        if self.fov_deg is not None:
            half = np.radians(self.fov_deg) / 2
            return float(self.size[0] / 2 / (half if self.projection == "fisheye" else np.tan(half)))
        entry = find_camera(self.model or "")
        return 1e3 * (self.focal_mm or entry.focal_mm) / entry.pitch_um

    @property
    def rate(self) -> float:
        """Frames per second; 30 where neither the description nor the catalogue has it."""
        return self.fps or (find_camera(self.model).fps if self.model else 30.0)

    @property
    def exposure_s(self) -> float:
        """Exposure time, seconds, at most the time of a frame."""
        return min(self.exposure_us * 1e-6, 1 / self.rate)

    @property
    def stamp_sigma_s(self) -> float:
        """Standard deviation of the capture time of one detection, seconds.

        The wand calibration finds the readout time of a rolling shutter. A detection's row is uniformly distributed
        over the image, and so is the part of the readout's error that its time has.
        """
        if self.stamp_sigma_ms is not None:
            return 1e-3 * self.stamp_sigma_ms
        shutter = self.shutter or (find_camera(self.model).shutter if self.model else "global")
        row_sigma_s = READOUT_SIGMA_S / np.sqrt(12) if shutter == "rolling" else 0.0
        return float(np.hypot(STAMP_SIGMA_S, row_sigma_s))

    def placed(self, position_m: Vector | Array, look_at_m: Vector | Array) -> Camera:
        """The camera at a position, directed at a point; its pose counts as exact.

        A camera exactly above its point looks down, with the image's upper side towards +y.
        """
        width, height = self.size
        position, aim = np.asarray(position_m, float), np.asarray(look_at_m, float)
        if np.hypot(*(aim - position)[:2]) < VERTICAL * abs(aim - position)[2]:
            aim = aim + VERTICAL * abs(aim - position)[2] * np.array([0.0, 1.0, 0.0])
        return Camera(
            width=width,
            height=height,
            fx=self.focal,
            fy=self.focal,
            cx=(width - 1) / 2,
            cy=(height - 1) / 2,
            model=self.projection,
            T_world_cam=Pose.from_matrix(look_at(position, aim)),
        )


class PlannedCamera(CameraKind, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A camera that is not mounted yet.

    Attributes:
        position_m, look_at_m: its position, and the point in the middle of its image, world.
    """

    position_m: Vector
    look_at_m: Vector

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.allclose(self.position_m, self.look_at_m):
            raise ValueError("look_at_m equals position_m; give another point")
        self.camera()

    def camera(self) -> Camera:
        """The camera at its planned pose, which counts as exact."""
        return self.placed(self.position_m, self.look_at_m)
