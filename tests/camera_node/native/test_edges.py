# SPDX-License-Identifier: BSD-3-Clause
"""Pixels of a single edge say of the pose what they say as pixels of a whole roundel."""

import subprocess
from pathlib import Path

import numpy as np

from tests.conftest import ROOT
from tests.native import build

NATIVE = ROOT / "camera_node" / "native"
SOURCES = "edge_pixels", "normal_equations", "ellipse"


def test_edges_apart_and_together_give_the_same_normal_equations(tmp_path: Path):
    """All 13 x 13 products, by the moves of three ellipses and by the columns of the whole.

    Those of the whole are taken at a pixel, of an ellipse at the point of the edge that is nearest to it: half a blur
    (0.4 px) in radii of the hole, 0.3 of the diameter, is the difference, and what is left of it in a product of one
    column that is even across the edge and one that is odd.
    """
    driver = Path(__file__).with_name("edges.cpp")
    edges = build(NATIVE, driver, tmp_path, SOURCES)
    done = subprocess.run([edges], capture_output=True, check=True, timeout=60)
    diameter, _, parts, off = np.loadtxt(done.stdout.decode().splitlines()).T
    assert np.all(parts[diameter == 20] == 1)
    assert np.all(off[diameter == 20] == 0)
    assert np.all(parts[diameter >= 50] == 3)
    assert np.all(off < 0.4 / (0.3 * diameter))
