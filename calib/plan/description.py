# SPDX-License-Identifier: BSD-3-Clause
"""The description of a planned arena, as in `configs/plan.yaml`: room, robots, cameras, and where cameras may hang; and
the grid of places of its roundels."""

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from calib.plan.camera_kind import CameraKind, PlannedCamera, Vector
from calib.rig.precision_map import SIGMA_PX
from camera_node.foundation.arrays import Array, Mask
from camera_node.geometry.body import Body
from camera_node.sensor_model.imaging import Ground, Imaging

# Metres between grid points.
STEPS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)
MAX_CAMERAS = 64
MAX_ROOM_M = 200.0


@dataclass(frozen=True, slots=True)
class Volume:
    """A grid of points x (X,), y (Y,), z (Z,), ascending, metres; the points stand in the order of (Z, Y, X)."""

    x: Array
    y: Array
    z: Array

    @classmethod
    def covering(cls, low: ArrayLike, high: ArrayLike, points: int) -> "Volume":
        """The finest grid of round spacing over the box from `low` to `high` (3,) with at most about `points` points.

        The outermost points lie on the faces of the box. A box without height has one layer of points.
        """
        low, high = np.asarray(low, float), np.asarray(high, float)
        step = next((s for s in STEPS if np.prod(_counts(low, high, s)) <= points), STEPS[-1])
        counts = _counts(low, high, step)
        return cls(*(np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)))

    @property
    def shape(self) -> tuple[int, int, int]:
        """(Z, Y, X)."""
        return len(self.z), len(self.y), len(self.x)

    @property
    def points(self) -> Array:
        """(Z Y X, 3) the points, metres."""
        z, y, x = np.meshgrid(self.z, self.y, self.x, indexing="ij")
        return np.column_stack([x.ravel(), y.ravel(), z.ravel()])

    @property
    def cell_m(self) -> Array:
        """(3,) spacing along x, y and z; 0 where there is one layer."""
        return np.array([axis[1] - axis[0] if len(axis) > 1 else 0.0 for axis in (self.x, self.y, self.z)])


@dataclass(frozen=True, slots=True)
class Region:
    """A connected part of a volume: the box around its points, (3,) each, metres, and its share of the volume."""

    low: Array
    high: Array
    share: float

    def describe(self) -> str:
        """The box as text."""
        sides = zip("xyz", self.low, self.high, strict=True)
        box = ", ".join(f"{axis} {a:.2f}" + (f" to {b:.2f}" if b > a else "") for axis, a, b in sides)
        return f"{box} m ({self.share:.1%})"


def find_regions(volume: Volume, inside: Mask) -> list[Region]:
    """The connected regions of the points (N,) that are `inside`, largest first; neighbours share a coordinate line."""
    from scipy import ndimage

    labels = np.zeros(volume.shape, np.int32)
    ndimage.label(inside.reshape(volume.shape), output=labels)
    regions = []
    for k in range(1, int(np.max(labels, initial=0)) + 1):
        z, y, x = np.nonzero(labels == k)
        points = np.column_stack([volume.x[x], volume.y[y], volume.z[z]])
        regions.append(Region(points.min(axis=0), points.max(axis=0), len(points) / labels.size))
    return sorted(regions, key=lambda region: -region.share)


def _counts(low: Array, high: Array, step: float) -> Sequence[int]:
    return [int(np.ceil(side / step - 1e-9)) + 1 for side in high - low]


class Mount(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where cameras may hang: a point, a line, a rectangle or a box along the axes, between two corners, world."""

    from_m: Vector
    to_m: Vector

    @property
    def corners(self) -> tuple[Array, Array]:
        """The lower and the upper corner, (3,) each."""
        both = np.array([self.from_m, self.to_m])
        return both.min(axis=0), both.max(axis=0)


class Suggestion(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What `--suggest` places.

    Attributes:
        camera: the kind of all cameras.
        mounts: where they may hang; the edges of the ceiling unless given.
    """

    camera: CameraKind
    mounts: dict[str, Mount] = {}


class Requirement(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the arena must achieve: errors of at most `error_mm` (root mean square) in `share` of the volume."""

    error_mm: float
    share: float = 0.95

    def __post_init__(self) -> None:
        if not (0 < self.error_mm <= 1e4 and 0 < self.share <= 1):
            raise ValueError("error_mm must be in (0, 1e4] and share in (0, 1]")


class ImageQuality(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Image quality of all cameras; the defaults are those of a focused camera in even light.

    Attributes:
        blur_px: standard deviation of the lens's blur, pixels.
        contrast: grey levels of the paper minus those of the ink, of 255.
        noise: standard deviation of a pixel's noise, grey levels.
        sigma_px: standard deviation of what calibration, print and light add to one coordinate of a centre, pixels.
        min_diameter_px: smallest minor axis of a roundel; None for the limit of the detector.
        ground: what surrounds the cards: clutter, or one grey level about midway between ink and paper.
        found_share: share of the roundels at the limit of size that are found in a new image.
    """

    blur_px: float = 0.7
    contrast: float = 150.0
    noise: float = 3.0
    sigma_px: float = SIGMA_PX
    min_diameter_px: float | None = None
    ground: Ground = "cluttered"
    found_share: float = 0.99

    def __post_init__(self) -> None:
        self.imaging(0.0)
        if not 0 <= self.sigma_px <= 10:
            raise ValueError(f"sigma_px is {self.sigma_px}; give 0 to 10 pixels")
        if self.min_diameter_px is not None and not 1 <= self.min_diameter_px <= 1000:
            raise ValueError(f"min_diameter_px is {self.min_diameter_px}; give 1 to 1000 pixels")
        if not 0.5 <= self.found_share <= 0.99:
            raise ValueError(f"found_share is {self.found_share}; give 0.5 to 0.99")

    def imaging(self, exposure_s: float) -> Imaging:
        """The image quality with an exposure time, seconds."""
        return Imaging(self.blur_px, self.contrast, self.noise, exposure_s, self.ground)


class PlannedRobots(Body, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """The robots: all carry the same level roundels.

    Attributes:
        heights_m: lowest and highest height of the roundels above the floor.
        speed_m_s: of the robots.
        count: number of robots.
    """

    heights_m: tuple[float, float] = (0.1, 0.1)
    speed_m_s: float = 0.5
    count: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.heights_m[0] <= self.heights_m[1] <= MAX_ROOM_M:
            raise ValueError("heights_m must be [low, high], metres above the floor")
        if not (0 <= self.speed_m_s <= 50 and 1 <= self.count <= 256):
            raise ValueError("speed_m_s must be in [0, 50] and count in [1, 256]")


class Plan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A planned arena.

    Attributes:
        area_m: x0, y0, x1, y1 of the floor on which robots move.
        room_m: x0, y0, x1, y1 of the room; the area unless given.
        ceiling_m: height of the room.
        robots: roundels, heights and speed.
        image: image quality.
        cameras: by name; empty to have them suggested.
        required: the precision that the arena must have.
        suggest: the cameras that `--suggest` places.
    """

    area_m: tuple[float, float, float, float]
    room_m: tuple[float, float, float, float] | None = None
    ceiling_m: float = 3.0
    robots: PlannedRobots
    image: ImageQuality = ImageQuality()
    cameras: dict[str, PlannedCamera] = {}
    required: Requirement | None = None
    suggest: Suggestion | None = None

    def __post_init__(self) -> None:
        for name, corners in (("area_m", self.area_m), ("room_m", self.room_m or self.area_m)):
            x0, y0, x1, y1 = corners
            if not (x0 < x1 and y0 < y1 and max(map(abs, corners)) <= MAX_ROOM_M):
                raise ValueError(f"{name} must be [x0, y0, x1, y1] with x0 < x1 and y0 < y1, metres")
        if not self.robots.heights_m[1] < self.ceiling_m <= MAX_ROOM_M:
            raise ValueError(f"ceiling_m is {self.ceiling_m}; give a height above that of the robots, metres")
        if len(self.cameras) > MAX_CAMERAS:
            raise ValueError(f"{len(self.cameras)} cameras; a plan has at most {MAX_CAMERAS}")

    def volume(self, points: int) -> Volume:
        """The grid over all places of roundels, with about so many points."""
        low, high = self.robots.heights_m
        return Volume.covering((*self.area_m[:2], low), (*self.area_m[2:], high), points)

    def mounts(self) -> list[Mount]:
        """Where suggested cameras may hang."""
        if self.suggest is not None and self.suggest.mounts:
            return list(self.suggest.mounts.values())
        x0, y0, x1, y1 = self.room_m or self.area_m
        z = self.ceiling_m
        corners = [(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]
        return [
            Mount(from_m=corner, to_m=corners[(k + 1) % len(corners)]) for k, corner in enumerate(corners)
        ]
