# SPDX-License-Identifier: BSD-3-Clause
"""Where a print is seen: its homography, the conic of its outline, curled paper, and exact coverage of a raster.

Lengths in the print's plane are in outer radii. The ring has the print's definition and nothing else: outer radius 1,
inner radius `inner_ratio` (0.6 unless another is given), card `surround_ratio` (`camera_node/geometry/body.py`), and
black arcs of its code (`camera_node/geometry/codes.py`).
"""

from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.geometry import codes

FOCAL = 600.0  # pixels
SIZE = (480, 640)
INNER, CARD = 0.6, 9 / 7
K = np.array([[FOCAL, 0, (SIZE[1] - 1) / 2], [0, FOCAL, (SIZE[0] - 1) / 2], [0, 0, 1]])
POINTS = 2048  # of a circle: they lie less than 1e-4 px from it up to 60 px
CELLS = 40  # of a half-tone across a disc: 85 lines an inch, as in newspapers, on a disc of 12 mm
INKED = 0.85  # share of a half-tone
APEX = 1.6  # distance of the apex of curled paper from the disc's centre, card radii
GRID = np.cos(np.linspace(-np.pi, np.pi, 400, endpoint=False))
BARE = float(np.quantile(GRID[:, None] + GRID, INKED))


@dataclass(frozen=True)
class Print:
    """A print in front of the camera.

    Attributes:
        uv: pixel of the disc's own centre.
        diameter: of the same disc seen frontally on the optical axis at its depth, pixels.
        tilt: between the normal and the line of sight, radians; `turn` its direction.
        square: whether the card is cut as a square, its side being the diameter of the round card.
        curl: height of the cone above the tangent plane at a card's radius from its axis, over the card's diameter;
            `axis` the direction of the cone's axis in the plane, radians.
        ratio: of the hole's and the disc's diameter.
        card: radius of the card.
        code: number of the code around the disc, 0 for none; its zero is at `spin` radians from the first axis.
        dot_gain: by which every edge of the ink lies farther out than it should.
        screened: whether the ink is a half-tone.
    """

    uv: tuple[float, float]
    diameter: float
    tilt: float
    turn: float
    square: bool = False
    curl: float = 0.0
    axis: float = 0.0
    ratio: float = INNER
    card: float = CARD
    code: int = codes.PLAIN
    spin: float = 0.0
    dot_gain: float = 0.0
    screened: bool = False

    @property
    def centre(self) -> Array:
        """(3,) of the disc, outer radii, camera frame."""
        return np.asarray(np.linalg.solve(K, [*self.uv, 1.0]), float) * (2 * FOCAL / self.diameter)

    @property
    def axes(self) -> Array:
        """(3, 3) columns: two directions in the plane, and the normal towards the camera."""
        sight = -self.centre / np.linalg.norm(self.centre)
        right = np.cross([0.0, 1.0, 0.0], sight)
        right /= np.linalg.norm(right)
        up = np.cross(sight, right)
        lean = np.cos(self.turn) * right + np.sin(self.turn) * up
        normal = np.cos(self.tilt) * sight + np.sin(self.tilt) * lean
        first = np.cos(self.tilt) * lean - np.sin(self.tilt) * sight
        return np.stack([first, np.cross(normal, first), normal], axis=1)

    @property
    def homography(self) -> Array:
        """(3, 3) from the plane to pixels."""
        return K @ np.column_stack([self.axes[:, :2], self.centre])

    def ellipse(self, radius: float = 1.0) -> tuple[Array, Array]:
        """Centre (2,) and full axes (2,), pixels, of a flat circle, from the conic H^-T diag(1, 1, -r^2) H^-1."""
        centre, form = self._outline(radius)
        return centre, 2 / np.sqrt(np.linalg.eigvalsh(form))

    @property
    def rotation(self) -> float:
        """`Roundel.rotation_rad` of the code's zero on the true outline of the disc."""
        centre, form = self._outline(1.0)
        values, axes = np.linalg.eigh(form)
        zero = self.image_of(np.array([[np.cos(self.spin), np.sin(self.spin)]]))[0]
        u, v = (axes * np.sqrt(values)) @ axes.T @ (zero - centre)
        return float(np.arctan2(v, u))

    def _outline(self, radius: float) -> tuple[Array, Array]:
        """Centre (2,) of the ellipse of a circle, and (2, 2) the form that is 1 on it."""
        back = np.linalg.inv(self.homography)
        conic = back.T @ np.diag([1.0, 1.0, -(radius**2)]) @ back
        centre = np.asarray(np.linalg.solve(conic[:2, :2], -conic[:2, 2]), float)
        return centre, conic[:2, :2] / -(conic[2, 2] + conic[:2, 2] @ centre)

    def image_of(self, plane: Array) -> Array:
        """Pixels (N, 2) of points (N, 2) of the print, on curled paper if it is curled."""
        along, across = self._along(plane)
        slope = 2 * self._height * CARD * APEX / ((APEX * CARD + along) * CARD) * across / CARD
        height = slope * across / 2
        shortened = across - slope * slope * across / 6  # the paper's own length along the bend stays
        c, s = np.cos(self.axis), np.sin(self.axis)
        x, y = c * along - s * shortened, s * along + c * shortened
        seen = K @ (self.centre[:, None] + self.axes @ np.stack([x, y, height]))
        return (seen[:2] / seen[2]).T

    def slope_of(self, plane: Array) -> Array:
        """Slope (N,) of the curled paper across the cone's axis, at points (N, 2) of the plane."""
        along, across = self._along(plane)
        return 2 * self._height * APEX / np.maximum(APEX * CARD + along, 0.2) * across / CARD

    @property
    def outlines(self) -> tuple[Array, Array, Array]:
        """Polygons (N, 2), pixels: the card, the black disc and the hole."""
        circle = _arc(np.linspace(0, 2 * np.pi, POINTS, endpoint=False))
        card = circle / np.abs(circle).max(axis=1, keepdims=True) if self.square else circle
        radii = 1 + self.dot_gain, self.ratio - self.dot_gain
        black, hole = (self.image_of(r * circle) for r in radii)
        return self.image_of(self.card * card), black, hole

    @property
    def ticks(self) -> list[Array]:
        """Polygons (N, 2), pixels: the black arcs of the code."""
        inner, outer = codes.INNER - self.dot_gain, codes.OUTER + self.dot_gain
        share, polygons = np.linspace(0, 1, POINTS // codes.SECTORS), []
        for start, end in codes.arcs(self.code) if self.code else ():
            angle = [
                self.spin + start - self.dot_gain / r + share * (end - start + 2 * self.dot_gain / r)
                for r in (inner, outer)
            ]
            along = (inner + share * (outer - inner))[:, None]
            far, near = outer * _arc(angle[1]), inner * _arc(angle[0][::-1])
            sides = along[::-1] * _arc(angle[1][-1:]), along * _arc(angle[0][:1])
            polygons.append(self.image_of(np.concatenate([far, sides[0], near, sides[1]])))
        return polygons

    @property
    def _height(self) -> float:
        return 2 * self.curl * CARD

    def _along(self, plane: Array) -> tuple[Array, Array]:
        """Coordinates along and across the cone's axis."""
        c, s = np.cos(self.axis), np.sin(self.axis)
        return plane @ [c, s], plane @ [-s, c]


def _arc(angle: Array) -> Array:
    """Points (N, 2) of the unit circle."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def screen(plane: Array) -> Array:
    """Whether points (N, 2) of the plane are bare in a half-tone: round holes on a grid at 45 degrees."""
    across = 2 * np.pi * CELLS / 2 * (plane @ np.array([[1, 1], [1, -1]]) / np.sqrt(2))
    return np.cos(across).sum(axis=1) > BARE


def coverage(polygon: Array, shape: tuple[int, int]) -> Array:
    """The share of each cell (h, w) inside a polygon (N, 2), exactly; cell (0, 0) covers [0, 1] x [0, 1].

    Every edge is divided where it leaves a cell. A piece adds its height to all cells on its right, and the part of it
    that is on its right to its own cell: Green's theorem, as in rasterisers of fonts. Edges are shorter than a cell.
    """
    h, w = shape
    start = np.clip(polygon, 0, np.array([w, h]) - 1e-9)
    step = np.roll(start, -1, axis=0) - start
    end = start + step
    crossed = np.floor(start) != np.floor(end)
    border = np.maximum(np.floor(start), np.floor(end))
    at = np.where(crossed, (border - start) / np.where(crossed, step, 1), 0)
    t = np.sort(np.column_stack([np.zeros(len(at)), at, np.ones(len(at))]), axis=1)
    middle = start[:, None] + step[:, None] * ((t[:, 1:] + t[:, :-1]) / 2)[..., None]
    height = (step[:, 1, None] * np.diff(t, axis=1)).ravel()
    column, row = np.floor(middle).astype(np.intp).reshape(-1, 2).T
    right = column + 1 - middle[..., 0].ravel()
    own = np.bincount(row * (w + 1) + column, height * right, h * (w + 1))
    next_one = np.bincount(row * (w + 1) + column + 1, height * (1 - right), h * (w + 1))
    return np.abs(np.cumsum((own + next_one).reshape(h, w + 1), axis=1)[:, :w])
