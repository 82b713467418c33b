# SPDX-License-Identifier: BSD-3-Clause
"""Models what a camera does to light before a program receives a grey picture.

The stages follow a colour camera's pipeline (Ramanath et al., "Color image processing pipeline", IEEE Signal
Processing Magazine 22, 2005) and the noise of EMVA 1288: light fall-off, exposure with saturation, noise, a Bayer
mosaic, denoising, sharpening, a tone curve, and compression.
"""

from typing import Literal

import cv2
import msgspec
import numpy as np

from camera_node.foundation.arrays import Array, Grey
from camera_node.simulation.floor import Picture

WHITE = 255.0
GAMMA = 1 / 2.2
SHARPEN_PX = 1.0  # standard deviation of the mean that sharpening subtracts
DENOISE_LEVELS = 4.0  # differences beyond so many standard deviations of the noise count as edges
# Red, green and blue of a neutral surface under daylight before the white balance.
DAYLIGHT = (0.55, 1.0, 0.7)

Tone = Literal["linear", "gamma", "webcam"]


class Sensor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A sensor and its image processing; the defaults are a monochrome machine-vision camera.

    Attributes:
        vignetting: share of the light that the corners lose.
        shading: change of the illumination across the width of the picture, over its mean; negative from the right.
        gain: factor of the light before saturation; paper of 215 is clipped from 1.2 on.
        noise: standard deviation of the dark noise, grey levels of 255 before the tone curve.
        shot_noise: variance of the photon noise for each grey level.
        bayer: whether a colour mosaic is interpolated.
        denoise_px: standard deviation of the edge-preserving mean, pixels; 0 for none.
        sharpen: share of the difference from the local mean that is added.
        tone: "linear", "gamma" (2.2) or "webcam" (a steeper S-shaped curve).
        jpeg: quality of the compression, 1 to 100; None for none.
    """

    vignetting: float = 0.0
    shading: float = 0.0
    gain: float = 1.0
    noise: float = 2.5
    shot_noise: float = 0.0
    bayer: bool = False
    denoise_px: float = 0.0
    sharpen: float = 0.0
    tone: Tone = "linear"
    jpeg: int | None = None

    def __post_init__(self) -> None:
        if not (0 <= self.vignetting < 1 and -1 < self.shading < 1 and 0 < self.gain <= 10):
            raise ValueError("vignetting must be in [0, 1), shading in (-1, 1) and gain in (0, 10]")
        if not (0 <= self.noise <= 50 and 0 <= self.shot_noise <= 10):
            raise ValueError("noise must be in [0, 50] and shot_noise in [0, 10]")
        if not (0 <= self.denoise_px <= 5 and 0 <= self.sharpen <= 3):
            raise ValueError("denoise_px must be in [0, 5] and sharpen in [0, 3]")
        if self.jpeg is not None and not 1 <= self.jpeg <= 100:
            raise ValueError("jpeg must be in [1, 100]")

    def expose(self, light: Array, rng: np.random.Generator) -> Grey:
        """The picture (h, w), uint8, of light (h, w) in grey levels of 255; light above 255 is possible."""
        level = light * (self.gain * self.falloff(light.shape))
        return self.develop(level, rng.standard_normal(level.shape))

    def develop(self, level: Array | Picture, noise: Array | Picture) -> Grey:
        """The picture (h, w), uint8, of exposed grey levels (h, w), with noise (h, w) of standard deviation 1."""
        image = np.clip(level + np.sqrt(self.variance(level)) * noise, 0, WHITE).astype(np.float32)
        if self.bayer:
            image = _through_mosaic(image)
        if self.denoise_px:
            image = self._denoise(image)
        if self.sharpen:
            blurred = np.asarray(cv2.GaussianBlur(image, (0, 0), SHARPEN_PX), np.float32)
            image = image + np.float32(self.sharpen) * (image - blurred)
        linear = np.clip(np.rint(image), 0, WHITE).astype(np.uint8)
        return _compress(tone_curve(self.tone)[linear], self.jpeg)

    def variance(self, level: Array | Picture) -> Array | Picture:
        """Variance of the noise at grey levels before the tone curve."""
        return self.noise**2 + self.shot_noise * np.maximum(level, 0)

    def falloff(self, shape: tuple[int, ...]) -> Array:
        """(h, w) share of the light that reaches each pixel: 1 in the middle of the picture."""
        v, u = (np.linspace(-1, 1, n) for n in shape[:2])
        corner = (u**2 + v[:, None] ** 2) / 2
        return (1 - self.vignetting * corner) * (1 + self.shading / 2 * u)

    def _denoise(self, image: Picture) -> Picture:
        edges = DENOISE_LEVELS * float(np.sqrt(self.variance(np.array(WHITE / 2))))
        return np.asarray(cv2.bilateralFilter(image, -1, edges, self.denoise_px), np.float32)


CLEAN = Sensor(noise=3.0)
MILD = Sensor(vignetting=0.3, shading=0.2, noise=1.5, shot_noise=0.03, tone="gamma", jpeg=80)
HARSH = Sensor(
    vignetting=0.5,
    shading=0.5,
    noise=3.0,
    shot_noise=0.1,
    bayer=True,
    denoise_px=1.0,
    sharpen=0.8,
    tone="webcam",
    jpeg=50,
)
SensorName = Literal["clean", "mild", "harsh"]
SENSORS: dict[SensorName, Sensor] = {"clean": CLEAN, "mild": MILD, "harsh": HARSH}


def tone_curve(tone: Tone) -> Grey:
    """(256,) received level of each linear level; 0 stays 0 and 255 stays 255."""
    share = np.arange(256) / WHITE
    encoded = share if tone == "linear" else share**GAMMA
    if tone == "webcam":
        encoded = encoded - 0.1 * np.sin(2 * np.pi * encoded)  # darker shadows, brighter highlights
    return np.rint(WHITE * encoded).astype(np.uint8)


def _through_mosaic(image: Picture) -> Picture:
    """A neutral picture through a Bayer mosaic, its white balance, interpolation and the conversion to grey."""
    h, w = image.shape
    red, green, blue = DAYLIGHT
    cell = np.array([[red, green], [green, blue]], np.float32)
    raw = np.clip(np.rint(image * np.tile(cell, (h // 2 + 1, w // 2 + 1))[:h, :w]), 0, WHITE).astype(np.uint8)
    colours = cv2.cvtColor(raw, cv2.COLOR_BayerBG2BGR) / np.array([blue, green, red], np.float32)
    balanced = np.minimum(colours, WHITE).astype(np.float32)
    return np.asarray(cv2.cvtColor(balanced, cv2.COLOR_BGR2GRAY), np.float32)


def _compress(image: Grey, quality: int | None) -> Grey:
    if quality is None:
        return image
    coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.uint8)
