# SPDX-License-Identifier: BSD-3-Clause
"""Clocks that differ by up to a minute and run at other rates are found from the motion of one light."""

import re
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.rig.camera import DRIFT, OFFSET
from calib.rig.estimation import CLEAR
from calib.rig.recording import as_they_arrived
from calib.rig.rig import Rig, load_rig, save_rig
from calib.wand.alignment import align_clocks
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.calibrate import calibrate
from calib.wand.nominal_lens import nominal_lens
from calib.wand.scale import Distance
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from tests.calib.recordings import EPOCH_S, SimulatedRecording, WandScenario, record, with_clocks
from tests.calib.synthetic import EXACT, STICK, WAND, camera_errors, ring, roughly
from tests.calib.synthetic import record as record_ring

LIGHT = Body(diameter_m=0.1)
SECONDS = 30.0
MIDDLE_NS = round((EPOCH_S + SECONDS / 2) * 1e9)
PHONES = {"cam00": (0.0, 0.0), "cam01": (-41.3, 0.009), "cam02": (58.7, -0.0102)}


# A light before cameras that run freely and see it at once most of the time.
WAVED = WandScenario(
    cameras=3,
    arc=0.5,
    seconds=SECONDS,
    rate_hz=20,
    sigma_px=0.3,
    outliers=0.01,
    offset_ms=0,
    drift_ppm=0,
    numbered=True,
    sized=False,
    both_sides=True,
    wand=LIGHT,
)


@cache
def light() -> SimulatedRecording:
    """The recording of `WAVED`."""
    return record(WAVED)


def late_ms(recorded: SimulatedRecording, stamped: Iterable[tuple[int, Detections]]) -> dict[str, np.ndarray]:
    """By camera, how much later than the truth the stamps of messages are, in their order."""
    true_ns = {(m.camera, m.seq): m.t_ns for m in recorded.messages}
    late: dict[str, list[float]] = {}
    for t_ns, m in stamped:
        late.setdefault(m.camera, []).append(1e-6 * (t_ns - true_ns[m.camera, m.seq]))
    return {name: np.array(of) for name, of in late.items()}


@pytest.mark.slow
def test_offsets_of_a_minute_and_rates_of_one_percent_are_found_and_used():
    """Poses are as with equal clocks; true times follow from the rig to three of their standard deviations at its ends,
    0.45 ms, in `run` and `replay` too. One clock is right, and all share one offset that nothing shows."""
    recorded = light()
    stamped = with_clocks(recorded.messages, MIDDLE_NS, PHONES)
    gap = recorded.truth.cameras["cam00"].matrix()[:3, 3] - recorded.truth.cameras["cam02"].matrix()[:3, 3]
    distance = Distance.of(
        ("cam00", "cam02", float(np.linalg.norm(gap))), 0.001, list(recorded.truth.cameras)
    )
    exact = roughly(recorded.intrinsics, EXACT, with_sigma=True)  # a light determines no lenses
    result = calibrate(exact, LIGHT, stamped, distance)
    assert camera_errors(result.rig, recorded.truth)[0].max() < 5e-3
    # Offsets hold in the middle of all stamps, a quarter of a minute from that of the recording.
    assert re.search(
        r"'cam01' the stamps are 4[01]\.\d s earlier .* 0\.\d\d % too fast", result.report.timing
    )
    late = late_ms(recorded, as_they_arrived(stamped, result.rig.cameras))
    common = np.mean([of.mean() for of in late.values()])
    scale = np.polyfit(range(len(late["cam00"])), late["cam00"], 1)[0]  # the rate that all clocks share
    claimed = camera_covariance(result.adjusted)
    offset, drift = (claimed.of(group)[:, 0, :, 0].diagonal() for group in (OFFSET, DRIFT))
    most = 1e3 * CLEAR * np.sqrt(offset + (SECONDS / 2) ** 2 * drift).max()
    assert most < 0.5
    for of in late.values():
        shared = scale * (np.arange(len(of)) - len(of) / 2)
        assert np.abs(of - shared - common).max() < most


@pytest.mark.slow
def test_a_shift_of_seconds_is_named_as_such():
    recorded = light()
    stamped = with_clocks(recorded.messages, MIDDLE_NS, {"cam01": (13.6, 0.0)})
    result = calibrate(recorded.intrinsics, LIGHT, stamped)
    assert len(result.names) == 3
    assert "camera 'cam01' the stamps are 13.6 s later than those of the others" in result.report.timing
    with pytest.raises(CalibrationError, match=r"declared synchronous, but .*13\.6 s later"):
        calibrate(recorded.intrinsics, LIGHT, stamped, synchronous=True)


@pytest.mark.ci
def test_drifts_are_stored_and_hold_at_both_ends_of_a_recording(tmp_path: Path):
    """Clocks of 3000 ppm: after half of twelve seconds they are 9 ms apart, and the rig has the rest to 0.3 ms."""
    drifting = {"offset_ms": 150, "drift_ppm": 3000, "sigma_px": 0.1, "outliers": 0.0}
    recorded = record(replace(WAVED, seconds=12, wand=STICK, seed=2, **drifting))
    path = tmp_path / "rig.yaml"
    save_rig(calibrate(recorded.intrinsics, STICK, recorded.messages).rig, path)
    rig = load_rig(path)
    true_ns = {
        name: lambda t_ns, k=camera, rate=1e-6 * recorded.drift_ppm[name]: (
            t_ns + 1e6 * k.time_offset_ms + rate * (t_ns - 1e9 * (EPOCH_S + 6))
        )
        for name, camera in recorded.truth.cameras.items()
    }
    for t_s in (0.5, 11.5):
        t_ns = round(1e9 * (EPOCH_S + t_s))
        late = np.array([rig.cameras[n].capture_ns(t_ns) - true_ns[n](t_ns) for n in true_ns]) * 1e-6
        assert np.abs(late - late.mean()).max() < 0.3


@pytest.mark.parametrize("seed", [0, 3])
def test_clocks_before_a_slow_wand_are_found(seed: int):
    """Twenty seconds of a hand that moves below 0.4 Hz: many shifts correlate as well as the right one."""
    recorded = record(replace(WAVED, cameras=2, seconds=20, speed=0.3, wand=STICK, seed=seed))
    stamped = with_clocks(recorded.messages, MIDDLE_NS, {"cam01": (12.7, 0.008)})
    nominal = Rig(
        cameras={name: nominal_lens(c.width, c.height) for name, c in recorded.truth.cameras.items()}
    )
    alignment = align_clocks(nominal, STICK, stamped)
    late = late_ms(recorded, ((m.t_ns, m) for m in alignment.apply(stamped)))
    apart = (late["cam01"] - late["cam00"])[[0, -1]]
    assert np.abs(apart).max() < 20  # what the adjustment finds by itself is 320


def test_motions_of_different_wands_are_not_aligned():
    first, second = (
        record(WandScenario(cameras=2, seconds=15, rate_hz=20, numbered=True, both_sides=True, seed=seed))
        for seed in (1, 2)
    )
    mixed = [m for m in first.messages if m.camera == "cam00"]
    mixed += [m for m in second.messages if m.camera == "cam01"]
    assert not align_clocks(first.intrinsics, WAND, mixed).maps


@pytest.mark.ci
def test_clocks_that_a_server_keeps_are_not_changed():
    recorded = light()
    bounded = [msgspec.structs.replace(m, clock_error_us=500.0) for m in recorded.messages]
    assert not align_clocks(recorded.intrinsics, LIGHT, with_clocks(bounded, MIDDLE_NS, PHONES)).maps
    assert align_clocks(recorded.intrinsics, LIGHT, with_clocks(recorded.messages, MIDDLE_NS, PHONES)).maps


@pytest.mark.parametrize("seconds", [8.0, 20.0])
def test_clocks_that_agree_are_left_alone(seconds: float):
    arena = ring(4)
    messages = record_ring(arena, seconds, sigma_px=0.1, sized=False)
    assert not align_clocks(arena.intrinsics, arena.wand, messages).maps


def test_a_drift_of_a_recording_does_not_hold_for_a_running_camera():
    camera = msgspec.structs.replace(
        light().truth.cameras["cam00"], time_offset_ms=2.0, time_drift_ppm=1e4, time_reference_ns=10**9
    )
    assert camera.capture_ns(3 * 10**9) == 3 * 10**9 + 2_000_000 + 20_000_000
    assert camera.capture_ns(3 * 10**9, sent_ns=1) == 3 * 10**9 + 2_000_000
