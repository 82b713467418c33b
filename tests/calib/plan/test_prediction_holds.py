# SPDX-License-Identifier: BSD-3-Clause
"""Predicted errors and coverage hold in the simulated arena, with rendered images, the detector and the tracker."""

import numpy as np
import pytest

from tests.benchmarks.plan.coverage import measure_coverage
from tests.benchmarks.plan.precision import measure_precision


@pytest.mark.slow
def test_measured_errors_are_the_predicted_ones():
    """30 frame sets of some two degrees of freedom determine an error to 1 / sqrt(2 * 30 * 2) = 9 %, so that about
    97 % of the places are within 20 %; of 20 places at least 16 with more than 99.5 % probability."""
    got = measure_precision(30)
    assert got.robots >= 20
    assert got.within >= 0.8
    assert np.median(got.measured_mm / got.predicted_mm) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_detection_ends_at_the_predicted_edges_of_the_image():
    got = measure_coverage(6)
    distance = got.distance_m[got.by_image]
    assert len(distance) >= 12
    assert np.mean(np.abs(distance) <= 0.05) >= 0.9
