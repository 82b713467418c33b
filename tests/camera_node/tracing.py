# SPDX-License-Identifier: BSD-3-Clause
"""Ray-traced images of one roundel through any lens, smooth enough for numerical derivatives.

Each pixel is divided into samples. The ray of a sample meets the printed plane at some radius, and the coverage of an
edge falls linearly over one sample. The ray tracer uses neither ellipses nor a model of blurred edges, so it is a
reference for both.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from camera_node.foundation.arrays import Array, Grey
from camera_node.geometry import codes
from camera_node.geometry.lens import Lens


@dataclass(frozen=True)
class Sight:
    """A roundel in front of a camera, and its grey levels.

    Attributes:
        uv: raw pixel of the image of the disc's centre.
        distance_m: of the disc's centre from the camera, along the optical axis.
        diameter_m: d_o; `ratio` is d_i / d_o, `card` d / d_o.
        tilt: between the printed side's normal and the line of sight, radians; `turn` its direction.
        dark, bright, ground: grey levels; the ground surrounds the card.
        blur: standard deviation of the lens's Gaussian point spread, pixels, without the pixel's own width.
        code: number of the code around the disc, 0 for none, whose zero is at `spin` radians from the direction of the
            image's rows, counter-clockwise as seen in front of the print; `ring` has the radii of the code.
        bend: height of the middle of the card above its two ends, over the card's diameter: paper on a cylinder.
    """

    lens: Lens
    uv: tuple[float, float]
    distance_m: float
    diameter_m: float = 0.1
    tilt: float = 0.0
    turn: float = 0.0
    ratio: float = 0.6
    card: float = 9 / 7
    dark: float = 40.0
    bright: float = 190.0
    ground: float = 90.0
    blur: float = 0.7
    bend: float = 0.0
    code: int = 0
    spin: float = 0.0
    ring: tuple[float, float] = (codes.INNER, codes.OUTER)

    @property
    def position(self) -> Array:
        """(3,) the disc's centre, metres, camera frame."""
        return np.append(self.lens.normalise(self.uv)[0], 1.0) * self.distance_m

    @property
    def normal(self) -> Array:
        """(3,) unit vector out of the printed side, camera frame."""
        return self._axes.T @ [
            np.sin(self.tilt) * np.cos(self.turn),
            np.sin(self.tilt) * np.sin(self.turn),
            -np.cos(self.tilt),
        ]

    def with_normal(self, normal: Array) -> "Sight":
        """The same roundel with another normal (3,) of any length."""
        x, y, z = self._axes @ normal
        return replace(self, tilt=float(np.arctan2(np.hypot(x, y), -z)), turn=float(np.arctan2(y, x)))

    @property
    def _axes(self) -> Array:
        """Rows: two directions perpendicular to the line of sight, the first parallel to the rows, and the line."""
        line = self.position / np.linalg.norm(self.position)
        down = np.cross(line, [1.0, 0.0, 0.0])
        down /= np.linalg.norm(down)
        return np.array([np.cross(down, line), down, line])


def pixels_across(lens: Lens, diameter_m: float, px: float) -> float:
    """The distance at which a frontal disc of `diameter_m` is `px` wide."""
    return lens.fx * diameter_m / px


def trace(sight: Sight, pieces: int = 6) -> Array:
    """Grey levels (h, w) of the image of `sight.lens`, without noise, from `pieces` squared samples per pixel."""
    margin = int(np.ceil(4 * sight.blur)) + 1
    points = plane_points(sight, margin, pieces)
    radius = np.hypot(points[..., 0], points[..., 1])
    card, black, white = (_part(radius, r) for r in (sight.card, 1.0, sight.ratio))
    if sight.code:
        black = black + _code(sight, points, radius)
    fine = sight.ground + (sight.bright - sight.ground) * card - (sight.bright - sight.dark) * (black - white)
    if sight.blur:
        fine = cv2.GaussianBlur(fine, (0, 0), sight.blur * pieces, borderType=cv2.BORDER_REPLICATE)
    h, w = fine.shape[0] // pieces, fine.shape[1] // pieces
    whole = fine.reshape(h, pieces, w, pieces).mean(axis=(1, 3))
    return whole[margin : h - margin, margin : w - margin]


def _code(sight: Sight, points: Array, radius: Array) -> Array:
    """The coverage of each sample by the black sectors of the code."""
    inner, outer = sight.ring
    ring = _part(radius, outer) - _part(radius, inner)
    angle = np.arctan2(points[1:-1, 1:-1, 1], points[1:-1, 1:-1, 0]) - sight.spin
    cell = np.abs(radius[1:-1, 2:] - radius[1:-1, :-2]), np.abs(radius[2:, 1:-1] - radius[:-2, 1:-1])
    return ring * codes.black_share(
        sight.code, angle, np.hypot(*cell) / 2 / np.maximum(radius[1:-1, 1:-1], 0.1)
    )


def plane_points(sight: Sight, margin: int, pieces: int) -> Array:
    """(h, w, 2) points of the print, in outer radii, at each sample, with one more sample on every side.

    The first axis is the direction of the image's rows in the print's plane, the second one is a quarter turn from it,
    counter-clockwise as seen in front of the print. Bent paper is taken from above.
    """
    lens = sight.lens
    u, v = (_pieces(n, margin, pieces) for n in (lens.width, lens.height))
    if lens.distortion:
        xy = lens.normalise(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)).reshape(len(v), len(u), 2)
    else:
        xy = np.stack(np.meshgrid((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy), -1)
    n, c = sight.normal, sight.position
    first = np.array([1.0, 0.0, 0.0]) - n[0] * n
    axes = np.array([first, np.cross(n, first)]) / np.linalg.norm(first)
    rays = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=2)
    return np.asarray((_depth(xy, sight)[..., None] * rays - c) @ axes.T, float) / (sight.diameter_m / 2)


def _depth(xy: Array, sight: Sight) -> Array:
    """Depth at which rays (..., 2) meet the paper; a bent one's height falls with the square of a coordinate."""
    n, c, half = sight.normal, sight.position, sight.diameter_m * sight.card / 2
    along = np.cross(n, [0.0, 1.0, 0.0])
    along /= np.linalg.norm(along)
    slope, depth = xy @ n[:2] + n[2], np.zeros(())
    for _ in range(5 if sight.bend else 1):
        s = (xy @ along[:2] + along[2]) * depth - c @ along
        depth = (c @ n - 2 * sight.bend * half * (s / half) ** 2 * (depth > 0)) / slope
    return depth


def _pieces(n: int, margin: int, pieces: int) -> Array:
    return (np.arange(-margin * pieces - 1, (n + margin) * pieces + 1) + 0.5) / pieces - 0.5


def _part(radius: Array, edge: float) -> Array:
    """The coverage of each sample by the disc inside of an edge: it falls from 1 to 0 over one sample."""
    across = np.abs(radius[1:-1, 2:] - radius[1:-1, :-2])
    down = np.abs(radius[2:, 1:-1] - radius[:-2, 1:-1])
    return np.clip(0.5 + (edge - radius[1:-1, 1:-1]) / (np.maximum(across, down) / 2 + 1e-12), 0, 1)


def ellipse_of(sight: Sight) -> tuple[Array, Array]:
    """Centre (2,) and full axes (2,) in pixels of the outer edge's image, for a lens without distortion.

    From the dual conic c c^T - r^2 (I - n n^T) of a circle of radius r around c with normal n.
    """
    n, c, r = sight.normal, sight.position, sight.diameter_m / 2
    dual = sight.lens.K @ (np.outer(c, c) - r * r * (np.eye(3) - np.outer(n, n))) @ sight.lens.K.T
    dual /= dual[2, 2]
    centre = dual[:2, 2]
    return centre, 2 * np.sqrt(np.linalg.eigvalsh(np.outer(centre, centre) - dual[:2, :2])[::-1])


def expose(image: ArrayLike, noise: float, rng: np.random.Generator) -> Grey:
    """An 8-bit image with Gaussian noise."""
    light = np.asarray(image, float)
    return np.clip(np.rint(light + rng.normal(0, noise, light.shape)), 0, 255).astype(np.uint8)
