# SPDX-License-Identifier: BSD-3-Clause
"""Wands before rolling shutters: readout times are estimated where the recording shows them, and used where given."""

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from calib.commands.printed_report import print_report
from calib.rig.camera import READOUT
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.calibrate import calibrate
from calib.wand.quality.grade import assess
from calib.wand.wand_report import WandCalibration
from tests.benchmarks.calibration_honesty import clock_error
from tests.calib.recordings import SimulatedRecording, WandScenario, record
from tests.calib.synthetic import STICK, assert_honest

READOUT_MS = 30.0


def waved(
    readout_ms: float, offset_ms: float = 50.0, free_running: bool = True, seed: int = 5, seconds: float = 10
) -> SimulatedRecording:
    """Three cameras."""
    return record(
        WandScenario(
            cameras=3,
            seconds=seconds,
            rate_hz=30,
            sigma_px=0.2,
            outliers=0.02,
            both_sides=True,
            arc=0.5,
            offset_ms=offset_ms,
            drift_ppm=0.0,
            free_running=free_running,
            rolling_ms=readout_ms,
            wand=STICK,
            seed=seed,
        )
    )


def clock_chi2(result: WandCalibration, recorded: SimulatedRecording) -> float:
    """Chi-square of the clocks' offsets, with two degrees of freedom."""
    mean = clock_error(result, recorded.truth)
    assert mean is not None
    return 2 * mean


def require_true_clocks(result: WandCalibration, recorded: SimulatedRecording) -> None:
    """Offsets and poses deviate from the truth as their covariances state."""
    assert clock_chi2(result, recorded) < chi2.ppf(0.999, 2)
    assert_honest([(result, recorded.truth)])


def test_a_readout_time_is_estimated_and_its_row_times_used(capsys: pytest.CaptureFixture[str]):
    """It goes to the rig, where tracking finds it; the camera said nothing of it."""
    recorded = waved(READOUT_MS)
    result = calibrate(recorded.intrinsics, STICK, recorded.messages)
    error = result.readout_ms - READOUT_MS
    covariance = 1e6 * camera_covariance(result.adjusted).of(READOUT)[:, 0, :, 0]
    assert error @ np.linalg.solve(covariance, error) < chi2.ppf(0.999, 3)
    assert result.readout_sigma_ms.max() < 2.0
    for k, name in enumerate(result.names):
        assert result.rig.cameras[name].readout_us == pytest.approx(1e3 * result.readout_ms[k])
    require_true_clocks(result, recorded)
    assert result.as_dict()["readout_ms"]["cam00"]["value"] == pytest.approx(READOUT_MS, abs=6.0)
    print_report(result, assess(result, STICK))
    assert "rolling shutter, readout time of the image, ms: cam00" in capsys.readouterr().out


@pytest.mark.slow
def test_estimated_readout_times_and_clocks_are_unbiased():
    """Eight recordings: the weighted mean of the errors of all readout times is 0 within 3.3 of its standard
    deviations, which are 2 % of the readout time at most; and the errors are those that are stated."""
    information = weighted = readouts = clocks = 0.0
    seeds = range(10, 18)
    for seed in seeds:
        recorded = waved(READOUT_MS, seed=seed)
        result = calibrate(recorded.intrinsics, STICK, recorded.messages)
        covariance = 1e6 * camera_covariance(result.adjusted).of(READOUT)[:, 0, :, 0]
        error, ones = result.readout_ms - READOUT_MS, np.ones(3)
        information += ones @ np.linalg.solve(covariance, ones)
        weighted += ones @ np.linalg.solve(covariance, error)
        readouts += error @ np.linalg.solve(covariance, error)
        clocks += clock_chi2(result, recorded)
    bias_ms, sigma_ms = weighted / information, information**-0.5
    assert sigma_ms < 0.02 * READOUT_MS
    assert abs(bias_ms) < 3.3 * sigma_ms
    assert chi2.ppf(0.001, 3 * len(seeds)) < readouts < chi2.ppf(0.999, 3 * len(seeds))
    assert chi2.ppf(0.001, 2 * len(seeds)) < clocks < chi2.ppf(0.999, 2 * len(seeds))


def test_a_given_readout_time_is_used():
    """By the cameras' messages; synchronous cameras with rolling shutters still see the wand at different times."""
    recorded = waved(READOUT_MS, offset_ms=0.0, free_running=False, seconds=5)
    messages = [msgspec.structs.replace(m, readout_us=1e3 * READOUT_MS) for m in recorded.messages]
    result = calibrate(recorded.intrinsics, STICK, messages, synchronous=True)
    assert "captured one after another" in result.report.timing
    assert not result.synchronous
    assert result.readout_ms == pytest.approx(READOUT_MS)
    assert not result.readout_sigma_ms.any()
    assert all(camera.readout_us is None for camera in result.rig.cameras.values())
    assert not result.time_offset_ms.any()
    assert_honest([(result, recorded.truth)])


@pytest.mark.ci
def test_a_global_shutter_has_no_readout_time():
    recorded = waved(0.0, seconds=5)
    result = calibrate(recorded.intrinsics, STICK, recorded.messages)
    assert not result.readout_ms.any()
    assert all(camera.readout_us is None for camera in result.rig.cameras.values())
    assert "readout_ms" not in result.as_dict()
