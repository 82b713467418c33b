# SPDX-License-Identifier: BSD-3-Clause
"""Wand calibration: exact without noise, honest about its covariance, and explicit about faults."""

import re

import msgspec
import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.rig.rig import Rig
from calib.wand.calibrate import calibrate
from calib.wand.initial_rig import TwoViewGeometry, explain_disagreement
from calib.wand.labels import label_recording
from calib.wand.wand_report import WandCalibration
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from tests.calib.synthetic import (
    CAREFUL,
    WAND,
    Arena,
    assert_honest,
    assert_near,
    camera_distances,
    record,
    ring,
    roughly,
)


def run(arena: Arena, messages: list[Detections]) -> WandCalibration:
    return calibrate(arena.intrinsics, arena.wand, messages)


def test_exact_without_noise_for_synchronized_cameras():
    """The rounding of pixels and the motion prior remain, far below 0.1 mm."""
    arena = ring()
    result = run(arena, record(arena, free_running=False))
    assert_near(result.rig, arena.truth, 1e-4, 1e-4)
    assert not result.report.unplaced
    assert result.report.length_std_mm == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize(("seconds", "period_ms"), [(6, 100), (18, 300)], ids=["dense", "sparse"])
def test_exact_without_noise_for_free_running_cameras(seconds: float, period_ms: int):
    """Ignoring the timestamps, a quarter of a period apart at 1 m/s, would cost centimetres."""
    arena = ring()
    result = run(arena, record(arena, seconds, period_ns=period_ms * 1_000_000))
    assert_near(result.rig, arena.truth, 2e-4, 2e-4)


@pytest.mark.parametrize("runs", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_reported_covariance_is_honest(runs: int):
    """Squared Mahalanobis errors of all poses follow chi-square with 6C - 6 degrees per recording: their sum is within
    its 0.1 % and 99.9 % quantiles. Lens errors have the stated standard deviations."""
    arena = ring(3)
    rigs = [roughly(arena.intrinsics, CAREFUL, with_sigma=True, seed=seed) for seed in range(runs)]
    recordings = [record(arena, 4.0, sigma_px=0.1, seed=seed) for seed in range(runs)]
    results = [calibrate(rig, arena.wand, messages) for rig, messages in zip(rigs, recordings, strict=True)]
    assert_honest([(result, arena.truth) for result in results], exactly=True)


@pytest.mark.ci
def test_gross_errors_and_clutter_are_rejected_and_counted():
    """Noise of 0.1 px causes position errors of some 0.1 mm; 5 % of errors of up to 60 px would cause far more than
    3 mm in plain least squares."""
    arena = ring()
    numbered = run(arena, record(arena, sigma_px=0.1, outliers=0.05, numbered=True, sized=False))
    assert_near(numbered.rig, arena.truth, 3e-3, 1.5e-3)
    assert len(numbered.report.outliers) == sum(row.outliers for row in numbered.report.cameras) > 10
    cluttered = run(arena, record(arena, sigma_px=0.1, clutter=6, missing=0.05))
    assert_near(cluttered.rig, arena.truth, 3e-3, 1.5e-3)


def test_the_result_does_not_depend_on_the_order_of_cameras():
    """Reversing the names changes the rig by less than a sixth of its noise. The motion prior and the lens prior are
    estimated from the initial rig, which changes. Six seconds determine positions to 1.6 mm with unknown lenses."""
    arena = ring()
    messages = record(arena, 6.0, sigma_px=0.1)
    names = sorted(arena.truth.cameras)
    other = dict(zip(names, reversed(names), strict=True))
    renamed = Arena(Rig(cameras={other[n]: c for n, c in arena.truth.cameras.items()}))
    there = run(renamed, [msgspec.structs.replace(m, camera=other[m.camera]) for m in messages]).rig
    here = run(arena, messages).rig
    back = Rig(cameras={other[n]: c for n, c in there.cameras.items()})
    assert_near(back, here, 3e-4, 3e-4)


@pytest.mark.parametrize(
    "markers", [pytest.param(1, marks=pytest.mark.ci), 2, pytest.param(4, marks=pytest.mark.ci)]
)
def test_wands_with_other_numbers_of_markers(markers: int):
    """The size of a single roundel gives the scale to about 1 %; four markers form a plane."""
    points = ((0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (0.1, 0.25, 0.0), (0.33, 0.13, 0.0))[:markers]
    arena = ring(wand=Body(diameter_m=0.1, markers=points))
    result = run(arena, record(arena, 8.0, sigma_px=0.02))
    assert len(result.rig.placed()) == 4
    limit = 0.05 if markers == 1 else 1e-3
    assert_near(result.rig, arena.truth, limit, limit)


def test_a_light_without_size_gives_a_rig_up_to_scale():
    arena = ring(wand=Body(diameter_m=0.1))
    result = run(arena, record(arena, sigma_px=0.1, sized=False, seconds=20))
    assert not result.report.metric
    distances = [camera_distances(rig, result.names) for rig in (result.rig, arena.truth)]
    assert distances[0].max() == pytest.approx(1.0, abs=1e-3)
    assert distances[0] == pytest.approx(distances[1] / distances[1].max(), abs=3e-3)


def test_the_world_is_upright_with_its_origin_below_the_wand():
    """z is up within the noise for cameras without roll; the wand moves within a metre of the origin."""
    arena = ring()
    rig = run(arena, record(arena)).rig
    heights = [camera.matrix()[2, 3] for camera in rig.cameras.values()]
    truth = [camera.matrix()[2, 3] for camera in arena.truth.cameras.values()]
    assert np.diff(heights) == pytest.approx(np.diff(truth), abs=2e-3)
    assert 0 < min(heights) < max(heights) < 3


def test_errors_name_the_fault():
    arena = ring()
    messages = record(arena, 3.0)
    symmetric = Body(diameter_m=0.12, markers=((0.0, 0.0, 0.0), (0.25, 0.0, 0.0), (0.5, 0.0, 0.0)))
    with pytest.raises(CalibrationError, match=r"symmetric.*0\.250 m.*0\.500 m"):
        calibrate(arena.intrinsics, symmetric, record(ring(wand=symmetric), 3.0))
    with pytest.raises(CalibrationError, match=r"the wand differs from its file: .*; the file has 0\.250 m"):
        calibrate(arena.intrinsics, symmetric, messages)
    with pytest.raises(CalibrationError, match="one camera, 'cam0'"):
        run(arena, [m for m in messages if m.camera == "cam0"])
    with pytest.raises(CalibrationError, match=r"'north'.* not in the rig.*--camera north"):
        run(arena, [msgspec.structs.replace(m, camera="north") for m in messages])
    with pytest.raises(CalibrationError, match=r"800 x 601 .*800 x 600"):
        run(arena, [msgspec.structs.replace(m, height=601) for m in messages])
    alone = [m for m in messages if (m.t_ns // 1_000_000_000) % 4 == int(m.camera[3])]
    with pytest.raises(CalibrationError, match=r"no two cameras .*cam0 \d+, cam1 \d+"):
        run(arena, alone)
    longer = Body(diameter_m=0.12, markers=tuple((4 * x, y, z) for x, y, z in WAND.markers))
    with pytest.raises(CalibrationError, match="wand"):
        calibrate(arena.intrinsics, longer, messages)


def test_a_disagreement_is_explained_by_the_pairs_that_agree():
    arena = ring()
    messages = record(arena, sigma_px=0.1, numbered=True, sized=False)
    recording = label_recording(arena.intrinsics, arena.wand, messages)
    pairs = TwoViewGeometry(recording.detections, recording.lenses, arena.wand, recording.timing)
    sentence = explain_disagreement(recording.names, pairs, {"cam1": "it moved"})
    assert "camera 'cam1': it moved" in sentence
    assert re.search(
        r"Pairs that agree by themselves: .*'cam0' and 'cam\d' \(\d+% of their detections\)", sentence
    )
    assert "\n" not in sentence
