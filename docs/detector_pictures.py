# SPDX-License-Identifier: BSD-3-Clause
"""Renders the picture of detector_seen_refused.md: `python docs/detector_pictures.py`."""

from pathlib import Path

import cv2
import numpy as np

from camera_node.detection.detector import Detector
from camera_node.detection.overlay import draw_refused, draw_roundels
from camera_node.detection.refusals import RefusedRing, explain
from camera_node.detection.roundels import Roundels
from camera_node.foundation.arrays import Array, Grey
from camera_node.simulation.sensor import MILD
from tests.benchmarks.detector.pictures import Card, flat, paste

SIZE = (240, 640)
PAPER, INK, FLOOR = 190.0, 40.0, 90.0


def scene() -> Array:
    """The light (h, w) of roundels that are found, above, and of rings that are refused, below."""
    light = paste(flat(SIZE, FLOOR), [Card((150, 170), 44)], dark=120.0, bright=134.0)  # too faint
    cv2.rectangle(light, (270, 130), (350, 210), 140.0, -1)
    _draw(light, (310, 170), [(26, INK), (15, PAPER)])  # not on white paper
    _draw(
        light,
        (500, 170),
        [(50, PAPER), (42, INK), (35, PAPER), (28, INK), (21, PAPER), (14, INK), (8, PAPER)],
    )
    cv2.rectangle(light, (570, 135), (630, 205), PAPER, -1)
    letter = np.zeros(SIZE, np.uint8)
    cv2.putText(letter, "O", (580, 187), cv2.FONT_HERSHEY_COMPLEX, 1.6, 255, 4, cv2.LINE_AA)
    light += letter / 255 * (INK - light)
    found = [Card((60, 60), 40), Card((150, 60), 36, 0.9, 0.5), Card((230, 60), 15), Card((310, 60), 40)]
    cards = [*found, Card((400, 60), 44), Card((500, 60), 44), Card((600, 60), 30)]
    light = paste(light, [*cards, Card((60, 170), 44, ratio=0.85), Card((400, 170), 44)])
    light[30:90, 415:424], light[130:210, 404:440] = 120.0, 20.0  # cover a fifth; more than a half
    return light


def _draw(light: Array, at: tuple[int, int], discs: list[tuple[int, float]]) -> None:
    for radius, level in discs:
        cv2.circle(light, at, radius, level, -1, cv2.LINE_AA)


def inspect() -> tuple[Grey, Roundels, list[RefusedRing]]:
    """The picture of a mild camera, its roundels and its refused rings."""
    image = MILD.expose(scene(), np.random.default_rng(1))
    detector = Detector()
    detector.detect(image)  # learns the print
    found = detector.detect(image)
    return image, found, explain(detector, image, found)


if __name__ == "__main__":
    picture, roundels, refused = inspect()
    canvas = draw_roundels(picture, roundels)
    draw_refused(canvas, refused)
    to = Path(__file__).with_name("detector_seen_refused.png")
    cv2.imwrite(str(to), canvas)
    for ring in refused:
        print(ring.uv.round(), ring.axes_px.round(1), ring.text)
    print(len(roundels), roundels.uv.round().tolist())
