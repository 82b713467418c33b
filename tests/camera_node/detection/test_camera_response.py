# SPDX-License-Identifier: BSD-3-Clause
"""The detector behind a camera's processing: tone curves, light that falls off, compression, clipped paper."""

from functools import cache, partial

import msgspec
import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.simulation.sensor import HARSH, MILD, Sensor
from tests.benchmarks.detector.cameras import Errors, acquainted, covered, errors, over_exposed, share_found
from tests.benchmarks.detector.table import Run

RUN = Run("chords", Detector, False)
MILD_SHARE = 0.8  # goal for covered roundels behind a mild camera
CARDS = 90  # in three pictures


@cache
def known(sensor: Sensor) -> Detector:
    """A detector that has learned the response of a camera."""
    return acquainted(RUN, sensor)


@pytest.fixture
def mild() -> Detector:
    return known(MILD)


@pytest.mark.parametrize(("tone", "exponent"), [("linear", 1.0), ("gamma", 2.2)])
def test_the_tone_curve_is_learned_from_the_known_ratio(tone, exponent):
    """The print's ratio is known to 0.002, which is 5 % of the exponent for the roundels of these pictures."""
    detector = known(Sensor(noise=2.0, tone=tone))
    assert detector.tone_exponent == pytest.approx(exponent, rel=0.05)


def test_a_detector_with_other_settings_keeps_what_it_learned_about_the_camera(mild: Detector):
    assert mild.tone_exponent is not None
    assert mild.adjusted(min_contrast=20.0).tone_exponent == mild.tone_exponent > 1.5


@pytest.mark.parametrize(
    "sensor",
    [
        Sensor(noise=2.0, tone="gamma"),
        Sensor(noise=2.0, vignetting=0.5),
        Sensor(noise=2.0, shading=0.5),
        Sensor(noise=3.0, denoise_px=1.0),
        Sensor(noise=2.0, jpeg=80),
        MILD,
    ],
    ids=["gamma", "vignetting", "shading", "denoising", "JPEG", "mild"],
)
@pytest.mark.parametrize("band", [(14, 20), (32, 60)])
def test_centre_and_size_are_within_their_claims(sensor: Sensor, band):
    """The issue's goal is three times the claimed variance; without the model it was 10 to 30 times."""
    measured: Errors = errors(known(sensor), sensor, band, 2)
    assert measured.found > 0.97
    assert measured.centre < 3
    assert measured.size < 3


@pytest.mark.parametrize("change", [{"tone": "webcam"}, {"sharpen": 0.8}], ids=["S-shaped", "sharpened"])
def test_what_no_exponent_describes_is_within_the_claims(change):
    """Before the curvature that is left was an unknown, sizes had 13 and 5 times the claimed variance."""
    sensor = msgspec.structs.replace(MILD, **change)
    measured: Errors = errors(known(sensor), sensor, (20, 32), 2)
    assert measured.found > 0.9
    assert measured.centre < 3
    assert measured.size < 3


@pytest.mark.parametrize(("from_rim", "goal"), [(False, MILD_SHARE), (True, 0.9)])
def test_covered_roundels_are_found_behind_a_mild_camera(mild: Detector, from_rim, goal):
    """A fifth of the diameter is covered. Four binomial standard deviations of the goal are subtracted."""
    share = share_found(mild, MILD, partial(covered, 0.2, from_rim), CARDS // 30)
    assert share > goal - 4 * np.sqrt(goal * (1 - goal) / CARDS)


def test_a_camera_that_denoises_and_sharpens_is_learned():
    """Flat areas hide what processing does at edges. Before it was learned, no covered roundel was found.

    The goal is a third from the rim; four binomial standard deviations are subtracted.
    """
    detector, goal = known(HARSH), 1 / 3
    assert detector.tone_exponent is not None
    share = share_found(detector, HARSH, partial(covered, 0.2, True), CARDS // 30)
    assert share > goal - 4 * np.sqrt(goal * (1 - goal) / CARDS)


@pytest.mark.parametrize("paper", [308.0, 410.0])
def test_clipped_paper_is_found(paper):
    clean = Sensor(noise=3.0)
    assert share_found(known(clean), clean, partial(over_exposed, paper), 3) > 0.97
