# SPDX-License-Identifier: BSD-3-Clause
"""Covariances account for residuals that are correlated in time."""

from collections import Counter

import numpy as np
import pytest

from calib.commands.check import split_halves
from calib.wand.calibrate import calibrate
from calib.wand.quality.agreement import Agreement, CameraPoses, compare_calibrations
from calib.wand.wand_report import WandCalibration
from camera_node.detection.roundels import Roundels
from camera_node.foundation.arrays import Array
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from tests.calib.mishaps import repack
from tests.calib.recordings import WandScenario
from tests.calib.recordings import record as record_wand
from tests.calib.synthetic import EXACT, Arena, assert_honest, record, ring, roughly


def with_correlated_errors(messages: list[Detections], seed: int) -> list[Detections]:
    """Shift all centres of a camera together by 0.3 px RMS, with periods of 1 to 4 s."""
    rng = np.random.default_rng(seed)
    names = sorted(Counter(message.camera for message in messages))
    rate = 2 * np.pi / rng.uniform(1, 4, (len(names), 2, 4))
    phase = rng.uniform(0, 2 * np.pi, rate.shape)
    moved = []
    for message in messages:
        k = names.index(message.camera)
        off: Array = 0.3 / np.sqrt(2) * np.sin(rate[k] * message.t_ns * 1e-9 + phase[k]).sum(axis=1)
        seen = message.unpack()
        moved.append(repack(message, Roundels.from_points(seen.uv + off, 0.1, seen.id)))
    return moved


def halves(arena: Arena, messages: list[Detections]) -> tuple[list[WandCalibration], Agreement]:
    found = [calibrate(arena.intrinsics, arena.wand, half) for half in split_halves(messages)]
    return found, compare_calibrations(*map(CameraPoses.of_calibration, found))


@pytest.mark.ci
@pytest.mark.parametrize(
    ("correlated", "expected", "seeds"),
    [
        (True, 2.5, 1),
        pytest.param(True, 2.5, 4, marks=pytest.mark.slow),
        pytest.param(False, 1.0, 4, marks=pytest.mark.slow),
    ],
)
def test_halves_agree_within_their_covariance(correlated: bool, expected: float, seeds: int):
    """Compares the two halves of recordings. The summed chi-square of their differences has the degrees of freedom D as
    mean and (2 D)^1/2 as standard deviation; with independent errors it is within 4 of these, and the inflation is 1 up
    to chance.

    Blocks of 1 s see a part of errors with periods up to 4 s: standard deviations are right within a factor of 2;
    without inflation they are too small by more than 3, although adjusted lenses absorb some of these errors.
    """
    arena, chi2, degrees, plain, factors = ring(3), 0.0, 0, 0.0, []
    for seed in range(seeds):
        messages = record(arena, 20.0, sigma_px=0.1, seed=seed, numbered=True, sized=False)
        found, agreement = halves(arena, with_correlated_errors(messages, seed) if correlated else messages)
        chi2, degrees = chi2 + agreement.chi2, degrees + agreement.degrees
        factor = float(np.mean([half.adjusted.inflation for half in found]))
        plain, factors = plain + agreement.chi2 * factor, [*factors, factor]
    if correlated:
        assert np.mean(factors) > expected
        assert plain / degrees > 3.0**2  # the inflation is needed: more than the 2 that it leaves
        assert chi2 / degrees < 2.0**2
    else:
        assert np.mean(factors) == pytest.approx(expected, abs=0.15)
        assert chi2 == pytest.approx(degrees, abs=4 * np.sqrt(2 * degrees))


@pytest.mark.ci
def test_the_path_of_a_light_does_not_contradict_lenses():
    """A light before free-running cameras for 30 s: files declare the lenses exact, and that is used; poses are right
    within the 99.9 % quantile of chi-square. With a motion prior that acts on the cameras too, lenses were adjusted by
    90 px, and the squared error was 450 of 17."""
    light = Body(diameter_m=0.05)
    scenario = WandScenario(
        cameras=4, wand=light, seconds=20, rate_hz=20, sigma_px=0.2, outliers=0.02, offset_ms=50, drift_ppm=0,
        numbered=True, sized=False, both_sides=True, seed=2,
    )  # fmt: skip
    recorded = record_wand(scenario)
    result = calibrate(roughly(recorded.intrinsics, EXACT, with_sigma=True), light, recorded.messages)
    assert (np.abs(result.adjusted.state.lenses) < 1e-5).all()
    assert_honest([(result, recorded.truth)])
