# SPDX-License-Identifier: BSD-3-Clause
"""Pixel formats of GenICam cameras, by their names in the Pixel Format Naming Convention (PFNC), as 8-bit grey.

8 to 16 bits in words, and 10 or 12 bits packed in two ways: `p`, a stream of bits from the least significant one, and
`Packed` of GigE Vision, two pixels in three bytes.
"""

import re
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.foundation.arrays import Grey
from camera_node.sources.grey import BAYER

NAME = re.compile(r"(Mono|BayerRG|BayerGR|BayerGB|BayerBG)(8|10|12|14|16)(p|Packed)?")
MOSAICS = {"BayerRG": "RGGB", "BayerGR": "GRBG", "BayerGB": "GBRG", "BayerBG": "BA81"}
Bytes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """How the pixels of an image are stored.

    Attributes:
        bits: of one pixel.
        packing: "" for whole bytes, "p" or "Packed".
        mosaic: four letters as V4L2 names it; empty for grey.
    """

    bits: int
    packing: str
    mosaic: str

    @property
    def bits_per_pixel(self) -> int:
        """In memory."""
        if not self.packing:
            return 8 if self.bits == 8 else 16
        return 12 if self.packing == "Packed" else self.bits

    def to_grey(self, data: Bytes, width: int, height: int) -> Grey:
        """Grey levels (height, width), uint8, from the bytes of an image; full scale becomes 255.

        Raises:
            ValueError: there are too few bytes.
        """
        count = width * height
        if len(data) * 8 < count * self.bits_per_pixel:
            raise ValueError(f"{len(data)} bytes for {width} x {height} pixels")
        levels = self._levels(data, count)[:count].reshape(height, width)
        if self.bits > 8:
            levels = cv2.convertScaleAbs(levels, alpha=255 / (2**self.bits - 1)).astype(np.uint8, copy=False)
        if self.mosaic:
            return cv2.cvtColor(levels, BAYER[self.mosaic]).astype(np.uint8, copy=False)
        return np.array(levels, np.uint8) if levels.base is not None else levels.astype(np.uint8, copy=False)

    def _levels(self, data: Bytes, count: int) -> NDArray:
        if self.bits == 8:
            return data
        if not self.packing:
            return data[: 2 * count].view("<u2")
        if self.packing == "Packed":
            return _unpack_gige(data, count, self.bits)
        return _unpack_12p(data, count) if self.bits == 12 else _unpack_10p(data, count)


def parse_pixel_format(name: str) -> PixelFormat | None:
    """A format by its PFNC name, such as Mono12p; None for one that this program does not read."""
    match = NAME.fullmatch(name)
    if match is None or (match[3] and match[2] not in ("10", "12")):
        return None
    return PixelFormat(int(match[2]), match[3] or "", MOSAICS.get(match[1], ""))


def _groups(data: Bytes, count: int, pixels: int, size: int) -> NDArray[np.uint16]:
    """Groups of `size` bytes (N, size) that hold `pixels` pixels each, completed by zeros."""
    needed = -(-count // pixels) * size
    whole = data[:needed] if len(data) >= needed else np.pad(data, (0, needed - len(data)))
    return whole.reshape(-1, size).astype(np.uint16)


def _unpack_gige(data: Bytes, count: int, bits: int) -> NDArray[np.uint16]:
    """Bytes: the upper 8 bits of the first pixel, the lower bits of both in a half each, the upper 8 of the second."""
    first, lower, second = _groups(data, count, 2, 3).T
    shift, mask = bits - 8, 2 ** (bits - 8) - 1
    return np.stack([first << shift | lower & mask, second << shift | lower >> 4 & mask], 1).ravel()


def _unpack_12p(data: Bytes, count: int) -> NDArray[np.uint16]:
    a, b, c = _groups(data, count, 2, 3).T
    return np.stack([a | (b & 0x0F) << 8, b >> 4 | c << 4], 1).ravel()


def _unpack_10p(data: Bytes, count: int) -> NDArray[np.uint16]:
    a, b, c, d, e = _groups(data, count, 4, 5).T
    pixels = [a | (b & 0x03) << 8, b >> 2 | (c & 0x0F) << 6, c >> 4 | (d & 0x3F) << 4, d >> 6 | e << 2]
    return np.stack(pixels, 1).ravel()
