# SPDX-License-Identifier: BSD-3-Clause
"""Codes of roundels: a ring of black and white sectors around the black disc, which gives a name and a heading.

`native/code/code_book.cpp` defines the words of the codes. Angles turn counter-clockwise as seen in front of the print;
sector k reaches from k to k + 1 sectors beyond the code's zero, which is the x axis of a robot with one marker.
"""

import math
from functools import lru_cache

import numpy as np

from camera_node import _core
from camera_node.foundation.arrays import Array

SECTORS = _core.CODE_SECTORS
INNER, OUTER = _core.CODE_RADII  # of the ring, outer radii of the roundel
CARD = 1.9  # radius of a card for a code: the white beyond the ring is a pixel wide at 20 px
STEP = math.tau / SECTORS
PLAIN = 0  # in place of a code: a roundel without one


@lru_cache
def words() -> tuple[int, ...]:
    """The words of codes 1, 2, ...: bit k is 1 where sector k is black."""
    return tuple(_core.code_words())


def is_code(number: int) -> bool:
    """Whether there is a code of this number."""
    return 1 <= number <= len(words())


def arcs(code: int) -> list[tuple[float, float]]:
    """Start and end of each black arc of a code, radians, the end above the start."""
    black = _black(code)
    starts = [k for k in range(SECTORS) if black[k] and not black[k - 1]]
    ends = [next(e for e in range(k, k + SECTORS) if not black[e % SECTORS]) for k in starts]
    return [(k * STEP, end * STEP) for k, end in zip(starts, ends, strict=True)]


def black_share(code: int, angle: Array, width: Array) -> Array:
    """The black share of parts of the ring, which extend over angles of `width` around `angle`, radians."""
    black = np.array(_black(code), float)
    total = np.concatenate([[0.0], np.cumsum(np.tile(black, 3))])  # from one turn before zero to one after
    middle, half = (
        (angle / math.tau) % 1.0 * SECTORS + SECTORS,
        np.clip(width / math.tau, 1e-6, 1) * SECTORS / 2,
    )
    at = np.arange(len(total))
    return (np.interp(middle + half, at, total) - np.interp(middle - half, at, total)) / (2 * half)


def _black(code: int) -> list[bool]:
    """Whether each sector of a code is black."""
    return [bool(words()[code - 1] >> k & 1) for k in range(SECTORS)]
