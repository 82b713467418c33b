# SPDX-License-Identifier: BSD-3-Clause
"""A wand of two markers without numbers is calibrated as well as with them, or refused."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.wand.calibrate import calibrate
from calib.wand.detections import Timing, gather
from calib.wand.labels import label_ends
from calib.wand.wand_report import WandCalibration
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from tests.calib.recordings import SimulatedRecording, WandScenario, record
from tests.calib.synthetic import CAREFUL, STICK, assert_honest, clock_errors_ms, roughly

# Visible from both sides, the stick often points at a camera: its image alone then does not distinguish the ends.
LIGHTS = WandScenario(
    cameras=5,
    seconds=12.0,
    rate_hz=20.0,
    sigma_px=0.3,
    sized=False,
    both_sides=True,
    wand=STICK,
    numbered=True,
)


def unnumbered(messages: list[Detections]) -> list[Detections]:
    return [msgspec.structs.replace(m, id=np.full(len(m), -1, "<i4").tobytes()) for m in messages]


def place(recorded: SimulatedRecording, messages: list[Detections]) -> WandCalibration:
    return calibrate(recorded.intrinsics, STICK, messages)


def trace(result: WandCalibration) -> float:
    return float(np.trace(result.covariance))


@pytest.mark.ci
@pytest.mark.parametrize("seeds", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_the_covariance_is_that_with_numbers(seeds: int):
    """Clock offsets of 150 ms and 50 ppm, 5 % of gross errors, 10 % missing markers. Frames with a missing or wrong
    marker may stay unlabeled: the variance grows by less than a quarter, and the squared Mahalanobis errors follow
    chi-square (0.1 % and 99.9 % quantiles of their sum). Lens errors have the stated standard deviations."""
    results = []
    for seed in range(seeds):
        recorded = record(replace(LIGHTS, seed=seed))
        lenses = roughly(recorded.intrinsics, CAREFUL, with_sigma=True, seed=seed)
        numbered, blind = (
            calibrate(lenses, STICK, messages)
            for messages in (recorded.messages, unnumbered(recorded.messages))
        )
        assert blind.names == numbered.names == sorted(recorded.truth.cameras)
        assert trace(blind) < 1.25 * trace(numbered)
        off_ms = np.abs(clock_errors_ms(blind, recorded.truth))
        assert (off_ms < np.minimum(4 * blind.time_sigma_ms, 0.3)).all()
        results.append((blind, recorded.truth))
    assert_honest(results, exactly=True)


@pytest.mark.parametrize(
    "scenario",
    [
        replace(LIGHTS, cameras=3, arc=0.5, offset_ms=0, drift_ppm=0, free_running=False),
        replace(LIGHTS, cameras=4, seconds=60, rate_hz=6, speed=0.6, outliers=0.02, missing=0.05),
        replace(LIGHTS, cameras=2, seconds=30, arc=0.3),
        replace(LIGHTS, wand=Body(diameter_m=0.12, markers=STICK.markers), sized=True, both_sides=False),
    ],
    ids=["in step", "webcams", "two cameras", "roundels"],
)
def test_ends_are_distinguished(scenario: WandScenario):
    """At least 90 % of the frames with both ends are labeled, 99.5 % of them right; the others contain a wrong
    detection. A swap in all cameras at once is allowed, and may change after a time without detections: each label is
    compared with the thirty around it."""
    recorded = record(scenario)
    names = sorted(recorded.truth.cameras)
    lenses = [recorded.truth.cameras[name] for name in names]
    frames, seen = gather(recorded.messages, names, lenses)
    labels = label_ends(
        Timing(frames.period_s()), replace(seen, label=np.full(len(seen), -1)), scenario.wand, lenses
    )
    both = (np.bincount(seen.frame) == 2)[seen.frame]
    assert (labels >= 0).sum() > 0.9 * both.sum()
    true_s = seen.t_s + 1e-3 * np.array([lens.time_offset_ms for lens in lenses])[seen.camera]
    order = np.argsort(np.where(labels >= 0, true_s, np.inf), kind="stable")[: (labels >= 0).sum()]
    right = (labels == seen.label)[order].astype(float)
    usual = np.median(np.lib.stride_tricks.sliding_window_view(np.pad(right, 15, "edge"), 31), axis=1)
    assert (right == usual).mean() > 0.995


@pytest.mark.ci
def test_cameras_with_faults_are_named():
    """One has a clock error of three seconds and is placed, one shares too few frame sets."""
    recorded = record(replace(LIGHTS, cameras=4, seconds=8.0))
    late = [
        msgspec.structs.replace(m, t_ns=m.t_ns + 3_000_000_000) if m.camera == "cam01" else m
        for m in unnumbered(recorded.messages)
        if m.camera != "cam03" or m.seq % 40 == 0
    ]
    result = place(recorded, late)
    assert "camera 'cam01' the stamps are 3.0 s later" in result.report.timing
    assert "at least 8" in result.report.unplaced["cam03"]
    assert result.names == ["cam00", "cam01", "cam02"]


def test_too_few_detections_are_refused():
    """No two cameras have simultaneous detections; and a recording of 0.2 s."""
    recorded = record(replace(LIGHTS, rate_hz=30.0))
    messages = unnumbered(recorded.messages)
    alone = [m for m in messages if (m.t_ns // 1_000_000_000) % 5 == int(m.camera[3:])]
    with pytest.raises(
        CalibrationError, match=r"no two cameras could be placed: .* at once in [01] frame sets"
    ):
        place(recorded, alone)
    with pytest.raises(CalibrationError):
        place(recorded, [m for m in messages if m.seq < 6])
