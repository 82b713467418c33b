# SPDX-License-Identifier: BSD-3-Clause
"""What a calibration tells of itself: here, of lenses that the wave corrected."""

from io import StringIO

import msgspec
import pytest
from rich.console import Console

from calib.commands.report import camera_table, print_report
from calib.wand.calibrate import calibrate
from calib.wand.quality.grade import assess
from calib.wand.quality.lens_change import describe, find_changes
from tests.calib.wave import Wave, record


def test_a_lens_that_was_off_is_told_with_its_correction(capsys: pytest.CaptureFixture[str]):
    """One camera's focal length is 1 % off in the file. What is told of it is true to four of its own sigmas, is what
    the rig has, and no other lens is accused."""
    wave = Wave(
        cameras=5, seconds=20.0, rate_hz=40.0, outliers=0.0, offset_ms=0.0, drift_ppm=0.0, sized=False
    )
    recorded = record(wave)
    rig, truth = recorded.intrinsics, recorded.truth.cameras["cam02"]
    rig.cameras["cam02"] = msgspec.structs.replace(
        truth, fx=1.01 * truth.fx, fy=1.01 * truth.fy, T_world_cam=None
    )
    result = calibrate(rig, wave.wand, recorded.messages)
    changes = find_changes(result.names, result.adjusted)
    assert set(changes) == set(rig.cameras)
    change = changes["cam02"]
    assert change.before.fx == pytest.approx(1.01 * truth.fx)
    assert change.after.fx == result.rig.cameras["cam02"].fx
    assert change.after.fx == pytest.approx(truth.fx, abs=4 * change.sigma[0] * truth.fx)
    lines = describe(changes)
    assert any(
        line.startswith(f"lens of cam02: f {1.01 * truth.fx:.1f} -> {change.after.fx:.1f} ± ")
        for line in lines
    )
    assert lines[-1] == "as they were, within 2 sigmas: the lenses of cam00, cam01, cam03, cam04"
    assert result.as_dict()["adjusted_lenses"]["cam02"]["before"]["fx"] == change.before.fx
    quality, text = assess(result, wave.wand), StringIO()
    print_report(result, quality)
    assert lines[1] in capsys.readouterr().out
    Console(width=80, file=text).print(camera_table(result, quality))
    table = [line for line in text.getvalue().splitlines() if line.startswith((" camera", " cam0"))]
    assert len(table) == 6  # at 80 columns no cell is folded
