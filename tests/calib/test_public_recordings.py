# SPDX-License-Identifier: BSD-3-Clause
"""Recordings of others are calibrated as well as by their own programs, with the commands of the documentation."""

from pathlib import Path

import pytest

from tests.benchmarks.calibration_recordings import DATA
from tests.benchmarks.public import CALISCOPE, MULTICAMSELFCAL, TAG_WAND, PublicSet, calibrate_set


@pytest.mark.parametrize("public", [TAG_WAND, MULTICAMSELFCAL, CALISCOPE], ids=lambda public: public.folder)
def test_a_recording_of_others_is_calibrated_as_well_as_by_them(tmp_path: Path, public: PublicSet):
    """All cameras are placed, and the figure is below the published one."""
    data = DATA / public.folder
    if not data.is_dir():
        pytest.skip(f"{data} is absent")
    rig, figure = calibrate_set(public, data, tmp_path)
    assert len(rig.placed()) == len(rig.cameras)
    assert figure < public.published_figure(data)
