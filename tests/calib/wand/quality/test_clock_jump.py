# SPDX-License-Identifier: BSD-3-Clause
"""A clock that jumps during the recording is named; other clocks are not."""

from dataclasses import replace

import msgspec
import pytest

from calib.wand.calibrate import calibrate
from calib.wand.wand_report import WandCalibration
from tests.calib.recordings import EPOCH_S, WandScenario, record
from tests.calib.synthetic import OLD, roughly

# Twelve seconds before four cameras, which all see the wand.
SHORT = WandScenario(cameras=4, arc=0.5, both_sides=True, seconds=12, rate_hz=20)


def calibrated(
    scenario: WandScenario, camera: str = "", at_s: float = 0.0, ms: float = 0.0, rough: bool = False
) -> WandCalibration:
    """Calibrate a recording in which a camera's stamps jump."""
    recorded, at_ns = record(scenario), (EPOCH_S + at_s) * 1e9
    messages = [
        msgspec.structs.replace(m, t_ns=m.t_ns + round(ms * 1e6))
        if m.camera == camera and m.t_ns > at_ns
        else m
        for m in recorded.messages
    ]
    rig = roughly(recorded.intrinsics, OLD, seed=scenario.seed) if rough else recorded.intrinsics
    return calibrate(rig, scenario.wand, messages)


@pytest.mark.parametrize(
    ("scenario", "camera", "ms"),
    [
        (replace(SHORT, seed=1), "cam03", 100.0),
        pytest.param(
            WandScenario(cameras=6, seconds=40, rate_hz=30, seed=3), "cam01", -20.0, marks=pytest.mark.slow
        ),
    ],
)
def test_a_clock_that_jumps_is_named(scenario: WandScenario, camera: str, ms: float):
    """The size is right within four standard deviations and 0.1 ms, which drifts of 50 ppm leave in some seconds; the
    time within 0.5 s, in which the camera may not see the wand."""
    result = calibrated(scenario, camera, scenario.seconds / 2, ms)
    jump = result.jump
    assert jump is not None
    assert jump.camera == camera
    assert jump.ms == pytest.approx(ms, abs=4 * jump.sigma_ms + 0.1)
    assert jump.sigma_ms < 0.5
    assert jump.at_s == pytest.approx(scenario.seconds / 2, abs=0.5)
    assert set(result.as_dict()["clock_jump"]) == {camera}
    assert "its clock jumps by" in jump.sentence()


@pytest.mark.ci
@pytest.mark.parametrize("seed", [6, *(pytest.param(k, marks=pytest.mark.slow) for k in (0, 2, 5, 7))])
def test_the_reason_of_a_camera_that_is_left_out_names_its_clock(seed: int):
    """A jump of 0.1 s half way: half of the camera's observations contradict the others. Another pose explains many of
    them, of all but the last recording, but none as well as the jump."""
    result = calibrated(replace(SHORT, seed=seed), "cam03", SHORT.seconds / 2, 100.0)
    assert "its clock jumps by +" in result.report.unplaced["cam03"]
    assert len(result.names) == 3


@pytest.mark.ci
@pytest.mark.parametrize("rough", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize("drift_ppm", [pytest.param(50.0, marks=pytest.mark.slow), 800.0])
def test_ordinary_clocks_do_not_jump(drift_ppm: float, rough: bool):
    """Neither free-running crystals nor clocks that a time service slews, with good and with inaccurate lenses."""
    scenario = WandScenario(cameras=5, seconds=12, rate_hz=20, drift_ppm=drift_ppm, seed=2)
    assert calibrated(scenario, rough=rough).jump is None
