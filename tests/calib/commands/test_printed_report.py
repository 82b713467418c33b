# SPDX-License-Identifier: BSD-3-Clause
"""The printed report of a calibration: corrected lenses, and a table that fits 80 columns."""

from io import StringIO

import msgspec
import pytest
from rich.console import Console

from calib.commands.printed_report import camera_table, print_report
from calib.wand.calibrate import calibrate
from calib.wand.quality.grade import assess
from calib.wand.quality.lenses import describe_lens_changes, find_lens_changes
from tests.calib.recordings import WandScenario, record


@pytest.mark.ci
def test_a_wrong_lens_is_reported_with_its_correction(capsys: pytest.CaptureFixture[str]):
    """The focal length of one camera is 1 % off in the file. The reported correction is right to four of its standard
    deviations and equals that of the rig; no other lens is reported as changed."""
    scenario = WandScenario(
        cameras=5, seconds=8.0, rate_hz=30.0, outliers=0.0, offset_ms=0.0, drift_ppm=0.0, sized=False
    )
    recording = record(scenario)
    rig, truth = recording.intrinsics, recording.truth.cameras["cam02"]
    rig.cameras["cam02"] = msgspec.structs.replace(
        truth, fx=1.01 * truth.fx, fy=1.01 * truth.fy, T_world_cam=None
    )
    result = calibrate(rig, scenario.wand, recording.messages)
    changes = find_lens_changes(result.names, result.adjusted)
    assert set(changes) == set(rig.cameras)
    change = changes["cam02"]
    assert change.before.fx == pytest.approx(1.01 * truth.fx)
    assert change.after.fx == result.rig.cameras["cam02"].fx
    assert change.after.fx == pytest.approx(truth.fx, abs=4 * change.sigma[0] * truth.fx)
    assert result.as_dict()["adjusted_lenses"]["cam02"]["before"]["fx"] == change.before.fx
    quality, text = assess(result, scenario.wand), StringIO()
    print_report(result, quality)
    printed = capsys.readouterr().out
    assert all(line in printed for line in describe_lens_changes(changes))
    changed = [line for line in printed.splitlines() if f"{change.after.fx:.1f}" in line]
    assert any("cam02" in line and f"{change.before.fx:.1f}" in line for line in changed)
    unchanged = [line for line in printed.splitlines() if "cam00, cam01, cam03, cam04" in line]
    assert len(unchanged) == 1
    Console(width=80, file=text).print(camera_table(result, quality))
    table = [line for line in text.getvalue().splitlines() if line.startswith((" camera", " cam0"))]
    assert len(table) == 6  # no cell is folded
