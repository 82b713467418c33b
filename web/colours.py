# SPDX-License-Identifier: BSD-3-Clause
"""Colours of the scene. A robot's colour derives from its name, so it is the same in every session and every list."""

import colorsys
import zlib

import numpy as np
from numpy.typing import ArrayLike, NDArray

BACKGROUND = (3, 3, 4)
CAMERA, LABELED, UNLABELED = (122, 162, 247), (255, 255, 255), (150, 150, 150)
CARD, CARD_UNSEEN = (255, 255, 255), (40, 40, 40)  # linear light
TRUE_POINT, SELECTED, PREVIEW = (235, 238, 245), (255, 214, 64), (255, 214, 64)
MASK, WAND_TRAIL = (239, 91, 91), (64, 200, 170)
COASTING, LOST = (222, 99, 10), (40, 20, 20)
LIGHTNESS, SATURATION = (0.55, 0.68), (0.75, 0.95)
DISPLAY_EXPONENT = 2.2  # Viser's meshes and lines take linear light: (c / 255)^2.2 of the displayed colour


def robot_colour(name: str) -> tuple[int, int, int]:
    """The displayed colour (sRGB) of a robot; equal names have equal colours on all machines."""
    digest = zlib.crc32(name.encode())
    hue, light, vivid = (digest & 0xFFFF) / 0x10000, (digest >> 16) & 1, (digest >> 17) & 1
    rgb = colorsys.hls_to_rgb(hue, LIGHTNESS[light], SATURATION[vivid])
    red, green, blue = (round(255 * part) for part in rgb)
    return red, green, blue


def css(colour: ArrayLike) -> str:
    """A colour for HTML."""
    return "#" + "".join(f"{int(part):02x}" for part in np.asarray(colour))


def to_linear(colours: ArrayLike) -> NDArray[np.uint8]:
    """Displayed colours (..., 3) as Viser's meshes and lines take them."""
    return np.round(255 * (np.asarray(colours) / 255) ** DISPLAY_EXPONENT).astype(np.uint8)


def robot_colours(names: list[str], tracking: list[str]) -> NDArray[np.uint8]:
    """(R, 3) colours of meshes by tracking state: the robot's own while tracked, others for coasting and lost."""
    own = own_colours(names)
    for row, state in zip(own, tracking, strict=True):
        if state != "tracked":
            row[:] = COASTING if state == "coasting" else LOST
    return own


def own_colours(names: list[str]) -> NDArray[np.uint8]:
    """(R, 3) colours of the robots' meshes and lines while they are tracked."""
    return to_linear([robot_colour(name) for name in names]).reshape(-1, 3)
