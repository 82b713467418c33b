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
    card, ink = _cover(sight, pieces)
    fine = sight.ground + (sight.bright - sight.ground) * card - (sight.bright - sight.dark) * ink
    return _to_pixels(fine, sight, pieces)


def trace_card(sight: Sight, pieces: int = 6) -> tuple[Array, Array]:
    """The light (h, w) of the card alone, and its coverage of each pixel; otherwise as `trace`."""
    card, ink = _cover(sight, pieces)
    light = sight.bright * card - (sight.bright - sight.dark) * ink
    return _to_pixels(light, sight, pieces), _to_pixels(card, sight, pieces)


def _to_pixels(fine: Array, sight: Sight, pieces: int) -> Array:
    """Blur samples, and average those of each pixel."""
    if sight.blur:
        blurred = cv2.GaussianBlur(fine, (0, 0), sight.blur * pieces, borderType=cv2.BORDER_REPLICATE)
        fine = np.asarray(blurred, float)
    h, w = fine.shape[0] // pieces, fine.shape[1] // pieces
    margin = _margin(sight)
    whole = fine.reshape(h, pieces, w, pieces).mean(axis=(1, 3))
    return whole[margin : h - margin, margin : w - margin]


def _cover(sight: Sight, pieces: int) -> tuple[Array, Array]:
    """The coverage of each sample by the card, and by ink: it falls from 1 to 0 over one sample at an edge."""
    x, y = plane_points(sight, _margin(sight), pieces)
    radius = np.hypot(x, y)
    inside = radius[1:-1, 1:-1]
    across = np.abs(radius[1:-1, 2:] - radius[1:-1, :-2])
    down = np.abs(radius[2:, 1:-1] - radius[:-2, 1:-1])
    width = np.maximum(across, down) / 2 + 1e-12

    def part(edge: float) -> Array:
        return np.clip(0.5 + (edge - inside) / width, 0, 1)

    ink = part(1.0) - part(sight.ratio)
    if sight.code:
        inner, outer = sight.ring
        angle = np.arctan2(y[1:-1, 1:-1], x[1:-1, 1:-1]) - sight.spin
        cell = np.hypot(across, down) / 2 / np.maximum(inside, 0.1)
        ink += (part(outer) - part(inner)) * codes.black_share(sight.code, angle, cell)
    return part(sight.card), ink


def plane_points(sight: Sight, margin: int, pieces: int) -> Array:
    """(2, h, w) points of the print, in outer radii, at each sample, with one more sample on every side.

    The first axis is the direction of the image's rows in the print's plane, the second one is a quarter turn from it,
    counter-clockwise as seen in front of the print. Bent paper is taken from above.
    """
    lens = sight.lens
    u, v = (_pieces(n, margin, pieces) for n in (lens.width, lens.height))
    if lens.distortion:
        x, y = lens.normalise(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)).T.reshape(2, len(v), len(u))
    else:
        x, y = (u[None] - lens.cx) / lens.fx, (v[:, None] - lens.cy) / lens.fy
    n, c = sight.normal, sight.position
    first = np.array([1.0, 0.0, 0.0]) - n[0] * n
    axes = np.array([first, np.cross(n, first)]) / np.linalg.norm(first)
    depth = _depth(x, y, sight)
    return np.stack([depth * _along(axis, x, y) - c @ axis for axis in axes]) / (sight.diameter_m / 2)


def _along(axis: Array, x: Array, y: Array) -> Array:
    """The component along an axis (3,) of rays through points x, y of the plane at distance one."""
    return axis[0] * x + axis[1] * y + axis[2]


def _depth(x: Array, y: Array, sight: Sight) -> Array:
    """Depth at which these rays meet the paper; a bent one's height falls with the square of a coordinate."""
    n, c, half = sight.normal, sight.position, sight.diameter_m * sight.card / 2
    along = np.cross(n, [0.0, 1.0, 0.0])
    along /= np.linalg.norm(along)
    slope, depth = _along(n, x, y), np.zeros(())
    for _ in range(5 if sight.bend else 1):
        s = _along(along, x, y) * depth - c @ along
        depth = (c @ n - 2 * sight.bend * half * (s / half) ** 2 * (depth > 0)) / slope
    return depth


def _margin(sight: Sight) -> int:
    """Pixels beyond the image whose light the blur brings into it."""
    return int(np.ceil(4 * sight.blur)) + 1


def _pieces(n: int, margin: int, pieces: int) -> Array:
    return (np.arange(-margin * pieces - 1, (n + margin) * pieces + 1) + 0.5) / pieces - 0.5


def shape_of(sight: Sight) -> tuple[Array, Array]:
    """Centre (2,) of the outer edge's image, pixels, and its shape S (2, 2), whose eigenvalues are the squared half
    axes; for a lens without distortion.

    From the dual conic c c^T - r^2 (I - n n^T) of a circle of radius r around c with normal n.
    """
    n, c, r = sight.normal, sight.position, sight.diameter_m / 2
    dual = sight.lens.K @ (np.outer(c, c) - r * r * (np.eye(3) - np.outer(n, n))) @ sight.lens.K.T
    dual /= dual[2, 2]
    centre = dual[:2, 2]
    return centre, np.outer(centre, centre) - dual[:2, :2]


def ellipse_of(sight: Sight) -> tuple[Array, Array]:
    """Centre (2,) and full axes (2,) of the same."""
    centre, S = shape_of(sight)
    return centre, 2 * np.sqrt(np.linalg.eigvalsh(S)[::-1])


def expose(image: ArrayLike, noise: float, rng: np.random.Generator) -> Grey:
    """An 8-bit image with Gaussian noise."""
    light = np.asarray(image, float)
    return np.clip(np.rint(light + rng.normal(0, noise, light.shape)), 0, 255).astype(np.uint8)
