# SPDX-License-Identifier: BSD-3-Clause
"""Each refusal and each reason of a camera that is not placed, with a recording that triggers it."""

import re
from collections.abc import Callable
from functools import cache

import msgspec
import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.rig.rig import Rig
from calib.wand.calibrate import calibrate
from calib.wand.labels import label_recording
from calib.wand.single_camera import recalibrate_camera
from calib.wand.spacing import MAX_ROUNDELS
from camera_node.detection.roundels import Roundels
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from tests.calib.mishaps import altered, repack
from tests.calib.synthetic import WAND, camera_errors, record, ring

Change = Callable[[Detections], Detections]


@cache
def numbered(cameras: int = 4) -> list[Detections]:
    """Six seconds of a wand with marker numbers."""
    return record(ring(cameras), 6.0, sigma_px=0.1, numbered=True, sized=False)


def without_roundels(message: Detections) -> Detections:
    return repack(message, message.unpack().select(np.zeros(len(message), bool)))


def anywhere(message: Detections) -> Detections:
    """All markers at random pixels."""
    seen, rng = message.unpack(), np.random.default_rng([message.seq, *message.camera.encode()])
    return repack(message, altered(seen, uv=rng.uniform(20, 580, seen.uv.shape)))


def of(name: str, change: Change, messages: list[Detections]) -> list[Detections]:
    """The recording with all messages of a camera changed."""
    return [change(message) if message.camera == name else message for message in messages]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (without_roundels, "it never saw the wand; wave the wand in front of it"),
        pytest.param(
            anywhere,
            r"its detections fit no other camera \(at best \d+% .* check its name, its clock",
            marks=pytest.mark.ci,
        ),
        (
            lambda message: message if message.seq < 6 else without_roundels(message),
            r"frame sets shared with other cameras: \d with cam0, .*at least 8",
        ),
        (
            lambda message: msgspec.structs.replace(message, t_ns=message.t_ns + 1_200_000_000),
            r"its timestamps are 1\.2\d s later than those of 'cam\d'; set its clock",
        ),
    ],
    ids=["never saw", "fits none", "few", "clock"],
)
def test_a_camera_that_is_not_placed_has_a_reason(change: Change, reason: str):
    arena = ring()
    result = calibrate(arena.intrinsics, WAND, of("cam3", change, numbered()))
    assert list(result.report.unplaced) == ["cam3"]
    assert re.search(reason, result.report.unplaced["cam3"])
    assert list(result.rig.placed()) == ["cam0", "cam1", "cam2"]


@pytest.mark.parametrize("sigma_px", [pytest.param(0.1, marks=pytest.mark.slow), 0.4])
@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param((0.2, 0.55), marks=pytest.mark.slow),
        (0.3, 0.55),
        pytest.param((0.19, 0.55), marks=pytest.mark.ci),
    ],
)
def test_a_wand_with_other_lengths_than_its_file_is_measured(wrong: tuple[float, float], sigma_px: float):
    """The ratio is known from single images; a wand of the ratio that the error states is calibrated."""
    arena, (middle, end) = ring(), wrong
    messages = record(arena, 8.0, sigma_px=sigma_px)
    false = Body(diameter_m=WAND.diameter_m, markers=((0.0, 0.0, 0.0), (middle, 0.0, 0.0), (end, 0.0, 0.0)))
    with pytest.raises(CalibrationError, match="the wand differs from its file") as error:
        calibrate(arena.intrinsics, false, messages)
    ratio = re.search(r"([0-9.]+) m from the nearer end and a length of ([0-9.]+) m", str(error.value))
    assert ratio is not None
    share, true_share = float(ratio[1]) / float(ratio[2]), 0.2 / 0.5
    assert share == pytest.approx(true_share, rel=0.015)  # 200 frames; each 5 % by the sizes' noise
    stated = Body(
        diameter_m=WAND.diameter_m, markers=((0.0, 0.0, 0.0), (share * 0.5, 0.0, 0.0), (0.5, 0.0, 0.0))
    )
    assert len(calibrate(arena.intrinsics, stated, messages).rig.placed()) == 4


def swapped(cameras: int, first: str, second: str) -> Rig:
    """The intrinsics of a ring of cameras with those of two exchanged."""
    given = dict(ring(cameras).intrinsics.cameras)
    given[first], given[second] = given[second], given[first]
    return Rig(cameras=given)


@pytest.mark.ci
def test_swapped_lenses_are_named():
    """Both cameras are named, and what to do; focal lengths differ by 8 %. The others are as accurate as without
    them."""
    arena = ring(5)
    messages = record(arena, 12.0, sigma_px=0.1, numbered=True, sized=False)
    result = calibrate(swapped(5, "cam0", "cam4"), WAND, messages)
    unplaced = result.report.unplaced
    assert set(unplaced) == {"cam0", "cam4"}
    for name, other in (("cam0", "cam4"), ("cam4", "cam0")):
        assert f"fit the intrinsics of '{other}', and vice versa; swap the two" in unplaced[name]
    assert camera_errors(result.rig, arena.truth)[0].max() < 2e-3


def test_a_majority_of_cameras_with_faults_is_refused():
    """The lenses of two of three cameras are swapped: one camera remains. The pairs that agree are named."""
    messages = record(ring(3), 20.0, sigma_px=0.05, numbered=True, sized=False)
    agreeing = r"contradict each other: .*swap the two.* Pairs that agree by themselves: '"
    with pytest.raises(CalibrationError, match=agreeing):
        calibrate(swapped(3, "cam0", "cam2"), WAND, messages)


def test_a_recording_without_the_wand_is_refused_with_counts():
    messages = [without_roundels(message) for message in numbered(2)]
    with pytest.raises(
        CalibrationError, match=r"the wand was in no frame \(too few roundels in the frame: 120\)"
    ):
        calibrate(ring(2).intrinsics, WAND, messages)


def test_two_cameras_that_rarely_see_the_wand_at_once_are_refused():
    """Six frames of one of them: fewer than eight frame sets."""
    messages = of("cam1", lambda m: m if m.seq < 6 else without_roundels(m), numbered(2))
    with pytest.raises(
        CalibrationError,
        match=r"at once in [1-6] frame sets.* \(frames with the wand: cam0 \d+, cam1 [1-6]\); .*views overlap",
    ):
        calibrate(ring(2).intrinsics, WAND, messages)


def test_a_camera_without_common_frames_cannot_be_recalibrated():
    arena = ring()
    messages = of("cam3", lambda m: msgspec.structs.replace(m, t_ns=m.t_ns + 60_000_000_000), numbered())
    with pytest.raises(
        CalibrationError, match=r"'cam3' can't be placed: .* 0 with cam0.*where its view overlaps"
    ):
        recalibrate_camera(arena.truth, WAND, messages, "cam3")


def test_a_wand_of_other_lengths_recalibrates_no_camera():
    half = Body(diameter_m=0.12, markers=tuple((x / 2, y, z) for x, y, z in WAND.markers))
    with pytest.raises(CalibrationError, match="lengths do not fit the detections; check the wand file"):
        recalibrate_camera(ring().truth, half, numbered(), "cam3")


@pytest.mark.parametrize(
    ("wand", "change", "reason"),
    [
        (WAND, without_roundels, "too few roundels in the frame"),
        (WAND, anywhere, "no wand among the roundels"),
        (Body(diameter_m=0.12), lambda message: message, "ambiguous"),
        (
            WAND,
            lambda message: repack(message, crowd(message.unpack())),
            f"more than {MAX_ROUNDELS} roundels in the frame",
        ),
        (
            WAND,
            lambda message: repack(message, of_another_object(message.unpack())),
            "no marker of the wand in the frame",
        ),
    ],
    ids=["few", "none", "ambiguous", "crowded", "other numbers"],
)
def test_unused_frames_have_a_reason(wand: Body, change: Change, reason: str):
    """Of a recording without marker numbers."""
    arena = ring(2)
    messages = [change(message) for message in record(arena, 1.0, sigma_px=0.1, clutter=0)]
    left_out = label_recording(arena.intrinsics, wand, messages).left_out
    assert left_out[0].most_common(1)[0][0] == reason


def crowd(seen: Roundels) -> Roundels:
    """The roundels with more than can be searched."""
    rng = np.random.default_rng(len(seen))
    return Roundels.from_points(np.vstack([seen.uv, rng.uniform(20, 580, (MAX_ROUNDELS, 2))]), 0.1)


def of_another_object(seen: Roundels) -> Roundels:
    """The roundels with numbers that no marker of the wand has."""
    return altered(seen, id=np.arange(7, 7 + len(seen), dtype=np.int32))
