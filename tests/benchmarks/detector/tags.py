# SPDX-License-Identifier: BSD-3-Clause
"""Square tags and their detectors, for comparison: OpenCV's ArUco, and AprilTag 3 if pyapriltags is installed."""

import importlib
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np

from camera_node.foundation.arrays import Array
from tests.benchmarks.detector.pictures import NOISE, Card, Grey, expose
from tests.benchmarks.detector.table import milliseconds


def tagged(ground: Array, there: list[Card], dictionary: int, rng: np.random.Generator) -> Grey:
    """The ground with square tags at the positions of the cards, as wide as their discs."""
    tags = cv2.aruco.getPredefinedDictionary(dictionary)
    image = np.asarray(cv2.GaussianBlur(ground, (0, 0), 0.7), float)
    for k, card in enumerate(there):
        side = round(card.diameter)
        tag = cv2.resize(
            cv2.aruco.generateImageMarker(tags, k, 200), (side, side), interpolation=cv2.INTER_AREA
        )
        whole = 40 + 150 / 255 * np.pad(tag.astype(float), side // 6, constant_values=255)
        x, y = (round(c - whole.shape[0] / 2) for c in card.uv)
        image[y : y + whole.shape[0], x : x + whole.shape[1]] = whole
    return expose(image, NOISE, rng)


def tag_detectors() -> dict[str, tuple[int, Callable[[Grey], object] | None]]:
    """By name: the tags' dictionary and their detector, or None if it is not installed."""
    aruco = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    try:
        april = importlib.import_module("pyapriltags").Detector(families="tag36h11", nthreads=1).detect
    except ImportError:
        april = None
    return {
        "ArUco": (cv2.aruco.DICT_4X4_50, aruco.detectMarkers),
        "AprilTag 3": (cv2.aruco.DICT_APRILTAG_36h11, april),
    }


def measure_tags(ground: Array, there: list[Card], seconds: float) -> list[str]:
    """Milliseconds of the tag detectors with tags at the positions of the cards."""
    cells = []
    for dictionary, find in tag_detectors().values():
        if find is None:
            cells.append("absent")
            continue
        image = tagged(ground, there, dictionary, np.random.default_rng(1))
        cells.append(f"{milliseconds(partial(find, image), seconds):.2f}")
    return cells
