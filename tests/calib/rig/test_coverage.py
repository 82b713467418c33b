# SPDX-License-Identifier: BSD-3-Clause
"""The coverage of an image, and the names of its regions."""

import numpy as np
import pytest

from calib.rig.coverage import Coverage, cell_centres, enumerate_words, region_of


def test_missing_regions_are_named():
    """With points in the right half only, the left third is missing."""
    width, height = 640, 480
    uv = cell_centres(width, height, (6, 8))
    coverage = Coverage.of(uv[uv[:, 0] > 300], width, height)
    assert coverage.share() == pytest.approx(0.5)
    assert set(coverage.missing()) == {"upper left", "left", "lower left"}
    left = np.broadcast_to(np.arange(8) < 4, (6, 8))
    assert coverage.share(~left) == 1
    assert coverage.missing(~left) == []
    assert region_of([630, 470], width, height) == "lower right"
    assert Coverage.of([[-1, 5], [np.nan, 5], [640, 5]], width, height).counts.sum() == 0
    assert enumerate_words(["a", "b", "c"]) == "a, b and c"
