# SPDX-License-Identifier: BSD-3-Clause
"""The blur of edges, by which a lens is focused, is measured on rendered images whose blur is known."""

import math

import cv2
import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.detection.roundels import Roundels
from camera_node.detection.sharpness import SECTORS, SIGMAS, edge_blur_px
from camera_node.node.node_status import BLURRED_PX, advise_focus
from tests.benchmarks.detector.pictures import Card, render
from tests.camera_node.tracing import expose

STEP = SIGMAS[1] / SIGMAS[0]  # between two blurs that are tried
PIXEL_VARIANCE = 1 / 12  # square pixels, of the blur by a pixel's area


def measure(image: np.ndarray) -> float | None:
    return edge_blur_px(image, Detector().detect(image))


@pytest.mark.parametrize("diameter", [26, 40, 80])
@pytest.mark.parametrize("tilt", [0.0, 0.7])
def test_the_blur_is_measured(diameter: float, tilt: float):
    """To one step of the blurs that are tried, and 15 % for the variance of the interpolation; it grows with it."""
    measured = []
    for blur in (0.5, 0.8, 1.2):
        disc = Card((80.3, 60.1), diameter, tilt=tilt, turn=0.5)
        found = measure(expose(render([disc], blur=blur), 2.0, np.random.default_rng(1)))
        assert found is not None
        assert found == pytest.approx(math.hypot(blur, PIXEL_VARIANCE**0.5), rel=STEP - 1 + 0.15)
        measured.append(found)
    assert measured == sorted(set(measured))


def test_motion_is_no_defocus():
    """A roundel that moves by 6 pixels during the exposure is nearly as sharp across its motion as at rest.

    A sector of directions begins at most its own width off the direction across the motion.
    """
    still = render([Card((80.3, 60.1), 50)], blur=0.7)
    moving = cv2.filter2D(still, -1, np.full((1, 7), 1 / 7))
    roundels = Detector().detect(expose(still, 2.0, np.random.default_rng(1)))
    rest, motion = (edge_blur_px(expose(i, 2.0, np.random.default_rng(2)), roundels) for i in (still, moving))
    assert rest is not None
    assert motion is not None
    angles = np.linspace(0, 2 * np.pi / SECTORS, 99)
    along = (
        7 / math.sqrt(12) * math.sqrt(np.mean(np.sin(angles) ** 2))
    )  # standard deviation of a box of 7 pixels
    assert rest / STEP <= motion <= math.hypot(rest, along) * STEP


def test_nothing_is_measured_without_roundels():
    assert measure(np.full((60, 80), 90, np.uint8)) is None
    assert measure(expose(render([Card((80, 60), 10)]), 2.0, np.random.default_rng(1))) is None
    assert edge_blur_px(np.empty((0, 0), np.uint8), Roundels.from_points(np.zeros((1, 2)), 0.1)) is None


def test_advice_names_the_blur():
    assert advise_focus(None) == advise_focus(BLURRED_PX - 0.01) == ""
    assert "2.0 px" in advise_focus(2.0)
