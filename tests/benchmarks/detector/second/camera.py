# SPDX-License-Identifier: BSD-3-Clause
"""Cameras of the second generator: photons, fixed pattern, mosaic, tone curves with a shoulder, unsharp mask, JPEG."""

import io
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from PIL import Image

from camera_node.foundation.arrays import Array, Grey

ELECTRONS = 25.0  # for each of 255 levels
READ = 1.0  # noise, levels
SHOULDER = 0.7  # share of the encoded scale from which bright light is compressed
BROWN = (0.5, 1.0, 0.65)  # red, green and blue of a neutral surface before the white balance
FILTER = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4.0  # bilinear interpolation of red and blue
GREEN = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4.0


Tone = Literal["linear", "srgb", "shoulder", "filmic"]


@dataclass(frozen=True)
class Camera:
    """A camera; the default one is monochrome and linear.

    Attributes:
        falls_off: whether light falls off with the fourth power of the cosine.
        tone: "linear"; "srgb"; "shoulder", sRGB that compresses its upper 30 %; or "filmic", the fit of ACES by
            Narkowicz (2016) and sRGB.
        colour: whether a Bayer mosaic is interpolated linearly, sharpened, and compressed with halved chroma.
        jpeg: quality of Pillow's encoder.
        iso_gain: how much less light the levels stand for, as the gain of a camera in a dark room makes them.
    """

    falls_off: bool = False
    tone: Tone = "linear"
    colour: bool = False
    jpeg: int | None = None
    iso_gain: float = 1.0

    def expose(self, light: Array, rng: np.random.Generator) -> Grey:
        """The picture (h, w), uint8, of light (h, w) in linear levels of 255."""
        fixed = np.random.default_rng(4)  # the same pattern in each picture
        h, w = light.shape
        gain = 1 + 0.006 * fixed.standard_normal((h, w))
        offset = 0.4 * fixed.standard_normal(w) + 0.25 * fixed.standard_normal((h, 1))
        if self.falls_off:
            y, x = np.mgrid[:h, :w] - np.array([h - 1, w - 1])[:, None, None] / 2
            light = light / (1 + (x * x + y * y) / 600.0**2) ** 2
        filters = _mosaic(h, w) if self.colour else 1.0
        per_level, read = ELECTRONS / self.iso_gain, READ * self.iso_gain
        electrons = rng.poisson(np.maximum(light * gain * filters, 0) * per_level)
        raw = np.clip(electrons / per_level + read * rng.standard_normal((h, w)) + offset, 0, 255)
        planes = _interpolate(np.rint(raw * 16) / 16) if self.colour else raw[..., None]
        levels = np.clip(np.rint(255 * curve(self.tone, np.clip(planes, 0, 255) / 255)), 0, 255)
        return _encode(levels.astype(np.uint8), self.jpeg)


def curve(tone: Tone, share: Array) -> Array:
    """Encoded share of the scale for a share of the light."""
    if tone == "linear":
        return share
    if tone == "filmic":
        x = 0.9 * share
        share = np.minimum(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 1)
    if tone == "shoulder":
        share = 1.3 * share
    encoded = np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1 / 2.4) - 0.055)
    if tone == "shoulder":
        over = np.maximum(encoded - SHOULDER, 0) / (1 - SHOULDER)
        encoded = np.minimum(encoded, SHOULDER) + (1 - SHOULDER) * (1 - np.exp(-over))
    return encoded


def _mosaic(h: int, w: int) -> Array:
    red, green, blue = BROWN
    return np.tile([[red, green], [green, blue]], (h // 2 + 1, w // 2 + 1))[:h, :w]


def _interpolate(raw: Array) -> Array:
    """(h, w, 3) balanced colours of an RGGB mosaic, sharpened."""
    h, w = raw.shape
    site = np.zeros((h, w, 3))
    site[::2, ::2, 0] = site[::2, 1::2, 1] = site[1::2, ::2, 1] = site[1::2, 1::2, 2] = 1
    planes = [
        cv2.filter2D(raw * site[..., k], -1, kernel, borderType=cv2.BORDER_REFLECT_101) / BROWN[k]
        for k, kernel in enumerate((FILTER, GREEN, FILTER))
    ]
    colours = np.stack(planes, axis=-1).astype(np.float64)
    return colours + 0.5 * (colours - np.asarray(cv2.blur(colours, (3, 3))))


def _encode(levels: Grey, quality: int | None) -> Grey:
    """Grey levels (h, w) of a picture (h, w, 1 or 3), after compression."""
    picture = Image.fromarray(levels.squeeze())
    if quality is not None:
        data = io.BytesIO()
        picture.save(data, "JPEG", quality=quality, subsampling=2)
        picture = Image.open(data)
    return np.asarray(picture.convert("L"), np.uint8)
