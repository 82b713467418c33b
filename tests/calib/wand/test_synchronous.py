# SPDX-License-Identifier: BSD-3-Clause
"""Synchronous cameras: frames with equal stamps are simultaneous, whatever the time between them and the motion."""

from functools import cache
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.wand.calibrate import calibrate
from calib.wand.wand_report import WandCalibration
from camera_node.detection.roundels import Roundels
from camera_node.geometry.pose import rotation_from_vector
from camera_node.protocol.messages import Detections
from tests.calib.mishaps import repack
from tests.calib.recordings import WandScenario
from tests.calib.recordings import record as record_wave
from tests.calib.synthetic import STICK, Arena, camera_errors, ring

ROWS, SIGMA_PX = 60, 0.5
PERIODS_NS = [1_000_000, 100_000_000, 10_000_000_000]


def random_rows(arena: Arena, period_ns: int, numbered: bool = True) -> list[Detections]:
    """Record a stick at random poses, one in each instant, with 0.5 px noise."""
    rng, messages = np.random.default_rng(3), []
    for k in range(ROWS):
        place = rng.uniform([-0.6, -0.6, 0.4], [0.6, 0.6, 1.5])
        points = STICK.points @ rotation_from_vector(rng.uniform(-2, 2, 3)).T + place
        for name, camera in arena.truth.cameras.items():
            uv = camera.project_world(points) + SIGMA_PX * rng.standard_normal((2, 2))
            seen = np.flatnonzero(camera.sees(uv))
            roundels = Roundels.from_points(uv[seen], SIGMA_PX, seen.astype(np.int32) if numbered else None)
            header = {"camera": name, "width": camera.width, "height": camera.height}
            messages.append(Detections.pack(roundels, seq=k, t_ns=k * period_ns, **header))
    return messages


@cache
def calibrated(period_ns: int, declared: bool) -> tuple[Arena, WandCalibration]:
    arena = ring(3, wand=STICK)
    return arena, calibrate(arena.intrinsics, STICK, random_rows(arena, period_ns), synchronous=declared)


@pytest.mark.parametrize("declared", [True, False], ids=["declared", "detected"])
@pytest.mark.parametrize(
    "period_ns",
    [
        pytest.param(PERIODS_NS[0], marks=pytest.mark.ci),
        pytest.param(PERIODS_NS[1], marks=pytest.mark.ci),
        PERIODS_NS[2],
    ],
    ids=["1 ms", "0.1 s", "10 s"],
)
def test_sixty_random_instants_are_placed_alike_at_any_period(period_ns: int, declared: bool):
    """The result depends on the order of the instants only: to rounding at all periods. Sixty instants determine
    positions to 5 mm, 1 sigma."""
    arena, result = calibrated(period_ns, declared)
    assert len(result.rig.placed()) == 3
    assert not result.time_sigma_ms.any()
    assert result.adjusted.used.mean() > 0.99
    assert camera_errors(result.rig, arena.truth)[0].max() < 0.02
    first = calibrated(PERIODS_NS[0], True)[1]
    for name, camera in first.rig.cameras.items():
        assert result.rig.cameras[name].matrix() == pytest.approx(camera.matrix(), abs=1e-6)


def test_the_chosen_model_is_reported_with_the_reason():
    assert "declared" in calibrated(PERIODS_NS[2], True)[1].report.timing
    assert "synchronous cameras: " in calibrated(PERIODS_NS[2], False)[1].report.timing
    assert "without clock offsets" in calibrated(PERIODS_NS[1], False)[1].report.timing


@pytest.mark.ci
def test_equal_stamps_of_cameras_that_are_not_synchronous_get_offsets():
    """A grabber stamps frames by their number, although one camera exposes 20 ms later: held-out frames show it."""
    scenario = WandScenario(
        cameras=4,
        arc=0.5,
        seconds=8,
        rate_hz=30,
        offset_ms=0,
        drift_ppm=0,
        free_running=False,
        both_sides=True,
    )
    recorded = record_wave(scenario)
    by_frame = [
        msgspec.structs.replace(m, t_ns=round(m.t_ns / 1e9 * 30) * 33_333_333, seq=m.seq)
        for m in recorded.messages
    ]
    steady = calibrate(recorded.intrinsics, scenario.wand, by_frame)
    assert not steady.time_sigma_ms.any()
    assert "synchronous cameras" in steady.report.timing
    late = [m for m in by_frame if m.camera != "cam01"]
    mine = [m for m in by_frame if m.camera == "cam01"]
    late += [msgspec.structs.replace(m, t_ns=n.t_ns) for n, m in pairwise(mine)]
    result = calibrate(recorded.intrinsics, scenario.wand, late)
    assert "clock offsets" in result.report.timing
    found = result.time_offset_ms[1] - result.time_offset_ms[[0, 2, 3]].mean()
    assert found == pytest.approx(1e3 / 30, abs=0.5)


def test_declared_cameras_without_equal_stamps_are_refused():
    arena = ring(3, wand=STICK)
    apart = [
        msgspec.structs.replace(m, t_ns=m.t_ns + 1_000 * int(m.camera[3]))
        for m in random_rows(arena, 10_000_000)
    ]
    with pytest.raises(
        CalibrationError, match=r"no two cameras have frames with equal stamps.*leave out --sync"
    ):
        calibrate(arena.intrinsics, STICK, apart, synchronous=True)


def test_residuals_are_stated_for_all_detections_and_gross_errors_by_their_size():
    """Every tenth detection is 30 px off: the share and the list say so, to the noise of the triangulated point. Three
    cameras have 6 equations for 3 unknowns: residuals are 0.5 px (2 / 2)^1/2 RMS without gross errors."""
    arena, messages, gross = ring(3, wand=STICK), [], []
    for message in random_rows(arena, 500_000_000):
        seen = message.unpack()
        if message.camera == "cam1" and message.seq % 5 == 0 and len(seen):
            seen.uv[0] += [0.0, 30.0]
            gross.append(message.t_ns * 1e-9)
        messages.append(repack(message, seen))
    report = calibrate(arena.intrinsics, STICK, messages).report
    given, held_out = report.given, report.held_out
    assert given is not None
    assert held_out is not None
    assert given.count == sum(len(m.unpack()) for m in messages)
    assert given.gross == pytest.approx(len(gross) / given.count, abs=0.01)
    assert given.all_px == pytest.approx(30 * np.sqrt(len(gross) / given.count), rel=0.1)
    assert given.residual_px == pytest.approx(SIGMA_PX, rel=0.15)
    assert held_out.residual_px == pytest.approx(SIGMA_PX, rel=0.3)
    assert sorted(o.t_s for o in report.outliers) == pytest.approx(gross)
    assert [o.off_px for o in report.outliers] == pytest.approx([30.0] * len(gross), abs=5.0)


def test_ends_without_numbers_are_distinguished_by_simultaneous_frames_alone():
    arena = ring(4, wand=STICK)
    result = calibrate(
        arena.intrinsics, STICK, random_rows(arena, 1_000_000, numbered=False), synchronous=True
    )
    assert len(result.rig.placed()) == 4
    assert camera_errors(result.rig, arena.truth)[0].max() < 0.02


def test_frames_whose_ends_cannot_be_distinguished_are_counted():
    """Ten instants have one camera alone, and the wand is elsewhere before and after: no other view names its ends."""
    arena = ring(4, wand=STICK)
    messages = random_rows(arena, 1_000_000_000, numbered=False)
    alone = [m for m in messages if m.camera == "cam0" and m.seq % 6 == 0 and len(m) == 2]
    recorded = [m for m in messages if m.seq % 6] + alone
    report = calibrate(arena.intrinsics, STICK, recorded, synchronous=True).report
    assert len(alone) > 5
    assert report.cameras[0].left_out["the ends of the wand cannot be distinguished"] == len(alone)
