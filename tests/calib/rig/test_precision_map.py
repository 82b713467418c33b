# SPDX-License-Identifier: BSD-3-Clause
"""A precision map has the errors of the area that cameras see, and shows where they do not."""

import numpy as np

from calib.rig.precision_map import FloorGrid, draw_precision, map_precision
from tests.calib.synthetic import ring


def test_a_map_of_a_ring_of_cameras():
    """0.1 px at 5 m and f = 520 px are 1 mm per camera; no camera sees the corners of 30 m x 30 m."""
    cameras = ring(4).truth.cameras
    precision = map_precision(list(cameras.values()), FloorGrid.covering([-15, -15], [15, 15], 0.1))
    middle = precision.sigma_mm[np.ix_(np.abs(precision.grid.y) < 2.5, np.abs(precision.grid.x) < 2.5)]
    assert np.isfinite(middle).all()
    assert middle.max() < 3
    assert np.isinf(precision.sigma_mm[0, 0])
    assert 0 < precision.covered < 1
    lines = precision.lines()
    assert len(lines) == len(precision.grid.y) + 2
    assert "·" in lines[1]
    picture = draw_precision(precision, cameras)
    assert picture.ndim == 3
    assert (picture != picture[0, -1]).any(axis=2).mean() > 0.2
