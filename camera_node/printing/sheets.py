# SPDX-License-Identifier: BSD-3-Clause
"""The sheets to print: roundels on cards, bodies of several roundels, and ChArUco boards."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from camera_node.foundation.errors import ConfigError
from camera_node.geometry import codes
from camera_node.geometry.body import Body
from camera_node.printing.drawing import GREY, Box, Circle, Label, Page, Polygon, Shape, Stroke

PAPER_MM = {
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}
MARGIN_MM = 8.0  # unprintable margin of most printers
RULER_MM = 100
FOOT_MM = 14.0  # at the lower edge, for the ruler
ARC_RAD = 0.02  # of a code between two corners of its outline: 5 um from the circle for 180 mm
CUT_MM = 4.0  # length of cut marks
# Of boards; the defaults of `roundel calibrate intrinsics --board`.
MARKER_RATIO, DICTIONARY = 0.75, cv2.aruco.DICT_4X4_1000


@dataclass(frozen=True)
class Card:
    """A roundel on a card: its body, the text beside it, and its code, 0 for none, whose zero is to the right."""

    body: Body
    text: str
    code: int = codes.PLAIN


def paper_size(name: str) -> tuple[float, float]:
    """Width and height of upright paper, mm; raises ConfigError if its name is not known."""
    if name not in PAPER_MM:
        raise ConfigError(f"--paper {name} is not known; choose one of {', '.join(PAPER_MM)}")
    return PAPER_MM[name]


def cards_for_page(body: Body, paper: str) -> int:
    """How many cards of a body's roundels fit on one page; raises ConfigError if none does."""
    columns, rows = _grid(body, paper)
    return columns * rows


def card_pages(cards: Sequence[Card], paper: str, title: str) -> list[Page]:
    """Cards to cut out, on as many pages as they need.

    Raises:
        ConfigError: a card does not fit on the paper, or the paper is not known.
    """
    width, height = paper_size(paper)
    columns, rows = _grid(cards[0].body, paper)
    pages = []
    for first in range(0, len(cards), columns * rows):
        page = _new_page(width, height, title)
        for k, card in enumerate(cards[first : first + columns * rows]):
            x = (k % columns + 0.5) * width / columns
            y = MARGIN_MM + (k // columns + 0.5) * (height - MARGIN_MM - FOOT_MM) / rows
            page.shapes += roundel(card, x, y)
        pages.append(page)
    return pages


def _grid(body: Body, paper: str) -> tuple[int, int]:
    """Columns and rows of cards on a page."""
    width, height = paper_size(paper)
    card = card_size(body)
    columns, rows = int((width - 2 * MARGIN_MM) // card), int((height - MARGIN_MM - FOOT_MM) // card)
    if not columns or not rows:
        raise ConfigError(f"a card of {card:.0f} mm does not fit on {paper}; choose a larger --paper")
    return columns, rows


def card_size(body: Body) -> float:
    """Side of the square card of a roundel, mm."""
    return 1e3 * body.diameter_m * body.card_ratio


def roundel(card: Card, x: float, y: float) -> list[Shape]:
    """A roundel with its card's outline, cut marks and a text in the card's lower left corner.

    A line from the edge of the card points to the zero of a code.
    """
    body, half = card.body, card_size(card.body) / 2
    shapes: list[Shape] = [Circle(x, y, half), *_print(body, x, y, card.code)]
    if card.code:
        shapes.append(Stroke(x + half, y, x + half - CUT_MM, y, GREY))
    for sx in (-1, 1):
        for sy in (-1, 1):
            u, v = x + sx * half, y + sy * half
            shapes += [Stroke(u, v, u - sx * CUT_MM, v, GREY), Stroke(u, v, u, v - sy * CUT_MM, GREY)]
    return [*shapes, Label(x - half + 1, y + half - 1.2, card.text, 2.5)]


def _print(body: Body, x: float, y: float, code: int, zero: float = 0.0) -> list[Shape]:
    """The black and white discs of a roundel, and its code, whose zero is at `zero` radians from the right, upwards."""
    radius = 500 * body.diameter_m
    shapes: list[Shape] = [Circle(x, y, radius, 0.0), Circle(x, y, body.inner_ratio * radius, 1.0)]
    for start, end in codes.arcs(code) if code else ():
        angles = zero + np.linspace(start, end, max(2, math.ceil((end - start) / ARC_RAD) + 1))
        ring = np.column_stack([np.cos(angles), -np.sin(angles)]) * radius
        corners = np.concatenate([codes.INNER * ring, codes.OUTER * ring[::-1]]) + np.array([x, y])
        shapes.append(Polygon(tuple(map(tuple, corners.tolist()))))
    return shapes


def body_page(body: Body, paper: str, name: str, title: str) -> Page | None:
    """All roundels of a flat body at their true places, with its axes; None if they do not fit on the paper.

    The page is the body seen from above: x points up, y left. The body's origin is a small cross.
    """
    points = 1e3 * body.points
    half = 500 * body.diameter_m * (codes.OUTER if any(body.codes) else 1)
    if np.ptp(points[:, 2]) > 0 or body.normals:
        return None  # roundels at different heights, or on several sides, are on different cards
    width, height = paper_size(paper)
    low, high = points[:, :2].min(0) - half, points[:, :2].max(0) + half
    room = np.array([height - MARGIN_MM - FOOT_MM, width - 2 * MARGIN_MM])  # along the body's x and y
    if ((high - low) > room).any():
        return None
    middle = (low + high) / 2
    page = _new_page(width, height, title)
    centre = np.array([width / 2, MARGIN_MM + room[0] / 2])

    def place(p: np.ndarray) -> tuple[float, float]:
        u, v = centre - (p - middle)[::-1]
        return float(u), float(v)

    for k, point in enumerate(points):
        x, y = place(point[:2])
        code = body.codes[k]
        text = str(k + 1) if code == codes.PLAIN else f"{k + 1}: {code}"
        page.shapes += [*_print(body, x, y, code, math.pi / 2), Label(x - 1.5, y + 1, text, 2.5)]
    x, y = place(np.zeros(2))
    page.shapes += [Stroke(x - 3, y, x + 3, y), Stroke(x, y - 3, x, y + 3)]
    page.shapes += [Label(MARGIN_MM, MARGIN_MM + 3, f"{name}: x points to the upper edge, y to the left one")]
    return page


def board_page(columns: int, rows: int, square_m: float, paper: str, title: str) -> Page:
    """A ChArUco board; raises ConfigError if it does not fit on the paper, or has an impossible size."""
    width, height = paper_size(paper)
    square = 1e3 * square_m
    size = columns * square, rows * square
    if not (3 <= columns <= 40 and 3 <= rows <= 40 and square >= 5):
        raise ConfigError(
            f"{columns} x {rows} squares of {square:g} mm are no board; give 3 to 40 of 5 mm or more"
        )
    if size[0] > width - 2 * MARGIN_MM or size[1] > height - MARGIN_MM - FOOT_MM:
        raise ConfigError(
            f"a board of {size[0]:g} x {size[1]:g} mm does not fit on {paper}; choose a larger --paper or --square"
        )
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARY)
    page = _new_page(width, height, title)
    x0, y0 = (width - size[0]) / 2, MARGIN_MM + (height - MARGIN_MM - FOOT_MM - size[1]) / 2
    marker = 0
    for row in range(rows):
        for column in range(columns):
            x, y = x0 + column * square, y0 + row * square
            if (row + column) % 2 == 0:  # as OpenCV draws boards: the upper left square is black
                page.shapes.append(Box(x, y, square, square))
            else:
                page.shapes += _marker(dictionary, marker, x, y, square)
                marker += 1
    return page


def _marker(dictionary: cv2.aruco.Dictionary, number: int, x: float, y: float, square: float) -> list[Shape]:
    """The black cells of an ArUco marker in the middle of a white square; runs of cells are one box."""
    bits = cv2.aruco.generateImageMarker(dictionary, number, dictionary.markerSize + 2) == 0
    cell = MARKER_RATIO * square / len(bits)
    x0, y0 = (start + (1 - MARKER_RATIO) / 2 * square for start in (x, y))
    shapes: list[Shape] = []
    for row, cells in enumerate(bits):
        edges = np.flatnonzero(np.diff(np.r_[0, cells.astype(int), 0]))
        for first, end in edges.reshape(-1, 2):
            shapes.append(Box(x0 + first * cell, y0 + row * cell, (end - first) * cell, cell))
    return shapes


def _new_page(width: float, height: float, title: str) -> Page:
    """A page with a ruler of 100 mm and a text at its foot."""
    y, x = height - 6.0, MARGIN_MM
    ticks = [Stroke(x + k, y, x + k, y - (3 if k % 10 == 0 else 1.5)) for k in range(0, RULER_MM + 1, 5)]
    text = f"{RULER_MM} mm if printed at 100 %; {title}"
    return Page(width, height, [Stroke(x, y, x + RULER_MM, y), *ticks, Label(x + RULER_MM + 2, y, text, 2.6)])
