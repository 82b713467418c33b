# SPDX-License-Identifier: BSD-3-Clause
"""Ray-traced images of prints: roundels and square tags, in the part of a camera's image that they cover.

Each sample of a pixel is a viewing ray through any lens that meets the print's plane; the print is looked up there. All
prints go through the same code, which has no model of an edge.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import msgspec
import numpy as np
from numpy.typing import ArrayLike

from camera_node.foundation.arrays import Array, Grey, Mask
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import rotation_from_vector
from camera_node.sensor_model.operational_space import Pattern
from tests.benchmarks.detector.pictures import dead_leaves, expose

DARK, BRIGHT, FLOOR = 40.0, 190.0, 90.0
SAMPLES = 5  # of a pixel in either direction
# The print at points (N, 2), metres: its grey level, and whether the sheet is there.
Shade = Callable[[Array], tuple[Array, Mask]]


@dataclass(frozen=True)
class Print:
    """A printed sheet: its radius from the centre in metres, and its shade."""

    reach_m: float
    shade: Shade


def roundel(pattern: Pattern) -> Print:
    """A roundel on a round card."""

    def shade(points: Array) -> tuple[Array, Mask]:
        radius = np.hypot(*points.T)
        ink = (radius < pattern.d_o / 2) & (radius > pattern.d_i / 2)
        return np.where(ink, DARK, BRIGHT), np.asarray(radius < pattern.d / 2, bool)

    return Print(pattern.d / 2, shade)


def square_tag(cells: Array, side_m: float) -> Print:
    """A tag of (n, n) cells, 1 for paper, with a margin of one cell; `side_m` is the side of its n cells."""
    whole = np.pad(cells.astype(float), 1, constant_values=1.0)
    n, cell = len(whole), side_m / len(cells)

    def shade(points: Array) -> tuple[Array, Mask]:
        at = np.floor(points * [1, -1] / cell + n / 2).astype(int)  # rows against the y axis
        inside = ((at >= 0) & (at < n)).all(axis=1)
        x, y = np.clip(at, 0, n - 1).T
        return np.where(whole[y, x] > 0.5, BRIGHT, DARK), np.asarray(inside, bool)

    return Print(n * cell / np.sqrt(2), shade)


@dataclass(frozen=True)
class View:
    """A print in front of a camera.

    Attributes:
        lens: the camera.
        uv: raw pixel of the image of the print's centre.
        distance_m: of the centre from the camera.
        slant, turn: angle between normal and line of sight, and its direction, radians.
        roll: rotation of the print in its plane, radians.
        blur_px: standard deviation of the lens's blur.
    """

    lens: Lens
    uv: tuple[float, float]
    distance_m: float
    slant: float = 0.0
    turn: float = 0.0
    roll: float = 0.0
    blur_px: float = 0.7
    T: Array = field(init=False, repr=False, compare=False)  # (4, 4) T_cam_print; +z out of the printed side

    def __post_init__(self) -> None:
        line = self.lens.rays([self.uv])[0]
        facing = _facing(line)
        tilt = rotation_from_vector(self.slant * np.array([-np.sin(self.turn), np.cos(self.turn), 0.0]))
        T = np.eye(4)
        T[:3, :3] = facing @ tilt @ rotation_from_vector([0.0, 0.0, self.roll])
        T[:3, 3] = self.distance_m * line
        object.__setattr__(self, "T", T)

    @classmethod
    def at(cls, lens: Lens, position: ArrayLike, normal: ArrayLike, blur_px: float = 0.7) -> "View":
        """The view of a print at a position (3,) with a normal (3,), camera frame."""
        p = np.asarray(position, float)
        x, y, z = _facing(p / np.linalg.norm(p)).T @ np.asarray(normal, float)
        u, v = lens.project(p)[0].tolist()
        slant, turn = float(np.arctan2(np.hypot(x, y), z)), float(np.arctan2(y, x))
        return cls(lens, (u, v), float(np.linalg.norm(p)), slant, turn, blur_px=blur_px)

    @property
    def position(self) -> Array:
        """(3,) the print's centre, camera frame."""
        return self.T[:3, 3]

    @property
    def normal(self) -> Array:
        """(3,) unit vector out of the printed side, camera frame."""
        return self.T[:3, 2]


def _facing(line: Array) -> Array:
    """(3, 3) columns x right, y up and z towards the camera, of a print that faces it along a unit ray (3,)."""
    right = np.cross([0.0, 1.0, 0.0], line)
    right /= np.linalg.norm(right)
    return np.column_stack([right, -np.cross(line, right), -line])


@dataclass(frozen=True, eq=False)
class Picture:
    """The light (h, w) of a part of a camera's image, and the lens of this part."""

    light: Array
    lens: Lens

    def expose(self, noise: float, rng: np.random.Generator) -> Grey:
        """The picture (h, w), uint8, with Gaussian noise."""
        return expose(self.light, noise, rng)


def window(view: View, reach_m: float, margin_px: int = 16) -> Lens:
    """The lens of the part of the image that a print of this radius covers."""
    lens = view.lens
    half = reach_m / view.distance_m * max(lens.fx, lens.fy) * 1.3 + margin_px
    u0, v0 = (max(0, int(c - half)) for c in view.uv)
    u1, v1 = (min(n, int(c + half) + 1) for c, n in zip(view.uv, (lens.width, lens.height), strict=True))
    return msgspec.structs.replace(lens, width=u1 - u0, height=v1 - v0, cx=lens.cx - u0, cy=lens.cy - v0)


def trace_print(view: View, sheet: Print, rng: np.random.Generator | None = None) -> Picture:
    """Render a print on clutter drawn by `rng`, or on an even floor."""
    lens = window(view, sheet.reach_m)
    margin = int(np.ceil(4 * view.blur_px)) + 1
    h, w = lens.height + 2 * margin, lens.width + 2 * margin
    ground = np.full((h, w), FLOOR) if rng is None else dead_leaves((h, w), rng)
    fine = cv2.resize(ground, (w * SAMPLES, h * SAMPLES), interpolation=cv2.INTER_LINEAR)
    to_plane = np.linalg.inv(np.column_stack([view.T[:3, :2], view.position]))  # p = [e1 e2 t] (a, b, 1) s
    points = np.asarray(cv2.perspectiveTransform(_normalised(lens, margin), to_plane), float)
    light, paper = sheet.shade(points.reshape(-1, 2))
    fine = np.where(paper.reshape(fine.shape), light.reshape(fine.shape), fine)
    blurred = np.asarray(cv2.GaussianBlur(fine, (0, 0), view.blur_px * SAMPLES), float)
    pixels = blurred.reshape(h, SAMPLES, w, SAMPLES).mean(axis=(1, 3))
    return Picture(pixels[margin : h - margin, margin : w - margin], lens)


def _normalised(lens: Lens, margin: int) -> Array:
    """(V, U, 2) x/z and y/z of the rays of all samples, linear between the pixels' centres."""
    u, v = (np.arange(-margin, n + margin, dtype=float) for n in (lens.width, lens.height))
    xy = np.nan_to_num(lens.normalise(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)), nan=1e3)
    return np.asarray(cv2.resize(xy.reshape(len(v), len(u), 2), None, fx=SAMPLES, fy=SAMPLES), float)
