# SPDX-License-Identifier: BSD-3-Clause
"""The detector on hostile images: under sanitizers, and with a limit on its time."""

import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_node.detection.detector import Detector
from tests.conftest import ROOT
from tests.native import fuzz

NATIVE = ROOT / "camera_node" / "native"


@pytest.mark.slow
def test_no_image_breaks_the_core(tmp_path: Path):
    """Sizes from 0 x 0, any stride, noise, rings, checkerboards and strokes, under AddressSanitizer and UBSan."""
    driver = Path(__file__).with_name("fuzz.cpp")
    assert fuzz(NATIVE, driver, 500, tmp_path) == (0, "")


def rings(size: tuple[int, int], step: int, *radii: float) -> np.ndarray:
    """A grid of concentric circles, alternately black and white from the outermost."""
    v, u = (x % step - step / 2 for x in np.mgrid[: size[0], : size[1]])
    within = sum((np.hypot(u, v) < radius).astype(int) for radius in radii)
    return cv2.GaussianBlur(np.where(within % 2, 30, 220).astype(np.float32), (0, 0), 0.6).astype(np.uint8)


def checkerboard(size: tuple[int, int], side: int) -> np.ndarray:
    v, u = np.mgrid[: size[0], : size[1]] // side
    return (220 * ((u + v) % 2)).astype(np.uint8)


def noise(size: tuple[int, int], blur: float) -> np.ndarray:
    rough = cv2.GaussianBlur(np.random.default_rng(1).normal(0, 1, size), (0, 0), blur)
    return np.where(rough > 0, 220, 30).astype(np.uint8)


HOSTILE = {
    "roundels of the smallest size": lambda size: rings(size, 10, 4, 2.4),
    "roundels side by side": lambda size: rings(size, 16, 6, 3.6),
    "bullseyes": lambda size: rings(size, 48, 22, 18, 14, 10, 6, 2),
    "rings within rings": lambda size: rings(size, size[1], *np.arange(2, size[1], 4.0)),
    "checkerboard": lambda size: checkerboard(size, 4),
    "letters": lambda size: noise(size, 1.2),
    "noise": lambda size: np.random.default_rng(1).integers(0, 256, size).astype(np.uint8),
}


def seconds(image: np.ndarray) -> float:
    """Processor time of one search by a new detector, minimum of three."""
    times = []
    for _ in range(3):
        detector = Detector(min_diameter_px=6, min_contrast=5)
        start = time.process_time()
        detector.detect(image)
        times.append(time.process_time() - start)
    return min(times)


@pytest.mark.parametrize("name", HOSTILE)
def test_the_time_for_the_worst_images_is_bounded(name: str):
    """Four times the pixels take about four times the time; a quadratic algorithm would take sixteen times.

    The limit is 5000 times that of an empty image: 2 us per pixel, a few fits for each possible position.
    """
    small, large = (seconds(HOSTILE[name](size)) for size in ((240, 320), (480, 640)))
    plain = seconds(np.full((480, 640), 128, np.uint8))
    assert large < 8 * small + 0.005
    assert large < 5000 * plain
