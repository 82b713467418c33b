# SPDX-License-Identifier: BSD-3-Clause
"""The normal equations of the single edges agree with those of the whole roundel."""

import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import ROOT
from tests.native import build

NATIVE = ROOT / "camera_node" / "native"
SOURCES = "edge_pixels", "normal_equations"


@pytest.mark.ci
def test_separate_edges_and_the_whole_give_the_same_normal_equations(tmp_path: Path):
    """All 13 x 13 products, by the Jacobians of three ellipses and by the columns of the whole.

    The whole model takes derivatives at the pixel, that of a single edge at the nearest point of the edge. They differ
    by about half a blur (0.4 px) over the radius of the hole (0.3 diameters), in products of a column that is even
    across the edge with an odd one.
    """
    driver = Path(__file__).with_name("edges.cpp")
    edges = build(NATIVE, driver, tmp_path, SOURCES)
    done = subprocess.run([edges], capture_output=True, check=True, timeout=60)
    diameter, _, parts, off = np.loadtxt(done.stdout.decode().splitlines()).T
    assert np.all(parts[diameter == 20] == 1)
    assert np.all(off[diameter == 20] == 0)
    assert np.all(parts[diameter >= 50] == 3)
    assert np.all(off < 0.4 / (0.3 * diameter))
