# SPDX-License-Identifier: BSD-3-Clause
"""Bent paper and uneven light: found, and within the claims."""

from dataclasses import replace

import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.geometry.lens import Lens
from tests.benchmarks.detector.bent import measure_bend
from tests.benchmarks.detector.cameras import acquainted, errors
from tests.benchmarks.detector.lighting import BAND, KINDS
from tests.benchmarks.detector.pictures import expose
from tests.benchmarks.detector.table import Run
from tests.camera_node.tracing import Sight, pixels_across, trace

RUN = Run("chords", Detector, False)
CLAIM = 3.0  # squared errors over claims, for each coordinate; without the fields 1000 to 2000, 6 and 3


@pytest.mark.parametrize("diameter", [40, 80])
def test_a_bend_is_removed_from_the_outline_and_its_unknown_part_is_claimed(diameter):
    """A hundredth of the card's diameter; the mean curvature may have either sign and does not show."""
    measured = measure_bend(RUN, 0.01, diameter, 8)
    assert measured.found == 1
    assert measured.centre < CLAIM
    assert measured.size < CLAIM


@pytest.mark.parametrize("diameter", [40, 80])
def test_flat_paper_is_not_taken_for_bent(diameter):
    """Mean squared errors of 16 coordinates have a standard deviation of 0.35; three of them below the mean."""
    assert measure_bend(RUN, 0.0, diameter, 8).centre > 1 - 3 * 0.35


@pytest.mark.parametrize("what", ["soft shadow", "gloss"])
def test_uneven_light_is_within_the_claims(what):
    sensor, disturb, _ = KINDS[what]
    measured = errors(acquainted(RUN, sensor), sensor, BAND, 3, disturb)
    assert measured.found > 0.7
    assert measured.centre < CLAIM


def test_a_roundel_that_was_bent_in_one_frame_is_flat_in_the_next_ones():
    """Parameters beside a bend are no solution without it, and a fit that resumed there found the bend again."""
    rng = np.random.default_rng(5)
    lens = Lens(width=100, height=100, fx=600.0, fy=600.0, cx=150.0, cy=50.0)
    flat = Sight(lens, (50.2, 50.1), pixels_across(lens, 0.1, 40.0), tilt=np.pi / 4, turn=0.4)
    detector, sigmas = Detector(), []
    for bend in (0.0, 0.0, 0.02, 0.0, 0.0, 0.0):
        (roundel,) = detector.detect(expose(trace(replace(flat, bend=bend), 4), 3.0, rng))
        sigmas.append(float(np.sqrt(np.trace(roundel.cov))))
    assert sigmas[2] > 2 * sigmas[0]
    assert max(sigmas[3:]) < 1.3 * max(sigmas[:2])
