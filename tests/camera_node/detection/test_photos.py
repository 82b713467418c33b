# SPDX-License-Identifier: BSD-3-Clause
"""The detector on photographs from other projects."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from camera_node.detection.detector import Detector
from camera_node.sources.recorded_frames import read_grey


def test_a_photograph_of_many_roundels(shared_data: Callable[[str], Path]):
    """48 roundels, 47 of them pasted into the image; the real one is on a sheet of paper at about (639, 402)."""
    found = Detector().detect(read_grey(shared_data("photos") / "lrse_many.png"))
    assert 44 <= len(found) <= 48
    assert np.linalg.norm(found.uv - [639, 402], axis=1).min() < 2


@pytest.mark.parametrize("name", ["cctag_01.png", "monocam_Test_Image.jpg"])
def test_other_round_markers_are_not_found(name: str, shared_data: Callable[[str], Path]):
    """Bullseyes of several rings, and tags inside of a disc."""
    assert len(Detector().detect(read_grey(shared_data("photos") / name))) == 0
