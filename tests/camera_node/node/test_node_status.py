# SPDX-License-Identifier: BSD-3-Clause
"""Advice about the exposure in the camera status."""

import numpy as np
import pytest

from camera_node.node.node_status import FULL, advise
from tests.benchmarks.detector.pictures import Card, render
from tests.camera_node.tracing import expose

NONE = np.empty((0, 2))
CENTRE = np.array([[80.0, 60.0]])


@pytest.mark.parametrize(
    ("bright", "kind", "change"),
    [
        (255.0, "saturated", "halve"),
        (220.0, "", ""),
        (120.0, "", ""),
        (80.0, "too dark", "2.5 times"),
        (40.0, "too dark", "5.0 times"),
    ],
)
def test_advice_depends_on_the_white_of_the_roundels(bright: float, kind: str, change: str):
    """For any background: here a dark one for bright paper and the reverse."""
    roundel = render([Card((80, 60), 40)], dark=bright / 8, bright=bright, ground=255.0 - bright)
    advice = advise(expose(roundel, 0, np.random.default_rng(1)), CENTRE)
    assert advice.partition(":")[0] == kind
    assert change in advice


def test_without_roundels_advice_depends_on_the_histogram():
    """A few highlights are ignored; a dark image needs more exposure, up to 16 times."""
    picture = np.full((80, 80), 90, np.uint8)
    assert advise(picture, NONE) == ""
    picture[:8, :16] = 255
    assert advise(picture, NONE) == ""
    picture[:40] = FULL
    assert advise(picture, NONE).startswith("saturated")
    assert advise(np.full((80, 80), 20, np.uint8), NONE).startswith("too dark: 10.0 times")
    assert advise(np.zeros((80, 80), np.uint8), NONE).startswith("too dark: 16.0 times")
    assert advise(np.empty((0, 0), np.uint8), NONE) == ""
