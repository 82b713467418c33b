# SPDX-License-Identifier: BSD-3-Clause
"""Codes around the roundels of a wand tell its markers, and those of robots do not disturb a wand without codes."""

import msgspec
import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.live.wand_position import locate_wand
from calib.wand.calibrate import calibrate
from calib.wand.labels import label_recording
from camera_node.geometry.body import Body, PrintedWand
from camera_node.protocol.messages import Detections
from tests.calib.synthetic import STICK, WAND, assert_honest, record, ring

CODES = (40, 3, 77)
# Equal distances: without codes, its ends look alike.
SYMMETRIC = PrintedWand(
    diameter_m=0.12, markers=((0.0, 0.0, 0.0), (0.25, 0.0, 0.0), (0.5, 0.0, 0.0)), code=CODES
)
ROBOT_CODE, ROBOT_UV = 1, (400.0, 300.0)


def read_codes(messages: list[Detections], codes: tuple[int, ...], unread: float = 0.0) -> list[Detections]:
    """The messages with the code of each numbered marker, of which a share `unread` is not certain."""
    rng, coded = np.random.default_rng(5), []
    for message in messages:
        roundels = message.unpack()
        certain = (roundels.id >= 0) & (rng.random(len(roundels)) >= unread)
        names = np.where(certain, np.array(codes)[roundels.id], -1)
        probability = np.where(certain, 1.0, np.nan)
        columns = {"id": names.astype("<i4").tobytes(), "id_probability": probability.astype("<f4").tobytes()}
        coded.append(msgspec.structs.replace(message, **columns))
    return coded


def beside_a_robot(messages: list[Detections]) -> list[Detections]:
    """The messages with the roundel of a robot that stands in each image, whose code is read."""
    columns = {
        "uv": np.array(ROBOT_UV, "<f8"),
        "cov": np.array([0.01, 0.0, 0.01], "<f4"),
        "axes_px": np.array([30.0, 28.0], "<f4"),
        "angle_rad": np.zeros(1, "<f4"),
        "ratio": np.full(1, 0.6, "<f4"),
        "contrast": np.full(1, 100.0, "<f4"),
        "id": np.full(1, ROBOT_CODE, "<i4"),
        "track": np.full(1, -1, "<i4"),
    }
    unread = np.full(1, np.nan, "<f4").tobytes()
    added = []
    for message in messages:
        joined = {name: getattr(message, name) + row.tobytes() for name, row in columns.items()}
        known = message.id_probability or unread * len(message)
        added.append(
            msgspec.structs.replace(message, **joined, id_probability=known + np.ones(1, "<f4").tobytes())
        )
    return added


@pytest.mark.parametrize("wand", [SYMMETRIC, msgspec.structs.replace(STICK, code=CODES[:2])])
def test_codes_are_numbers_of_markers(wand: Body):
    """The labels are those of a recording with numbers, although a robot with a code is in each image."""
    arena = ring(4, wand=wand)
    numbered = record(arena, 2.0, numbered=True)
    coded = beside_a_robot(read_codes(numbered, wand.codes))
    by_number, by_code = (
        label_recording(arena.intrinsics, wand, given).detections for given in (numbered, coded)
    )
    assert len(by_code)
    assert np.array_equal(by_code.label, by_number.label)
    assert np.array_equal(by_code.uv, by_number.uv)


def test_a_symmetric_wand_of_which_codes_are_unread_is_calibrated():
    """A third is unread. The squared Mahalanobis error is below the 99.9 % quantile of chi-square."""
    arena = ring(4, wand=SYMMETRIC)
    messages = read_codes(record(arena, 3.0, numbered=True, sigma_px=0.1), CODES, unread=0.33)
    assert_honest([(calibrate(arena.intrinsics, SYMMETRIC, messages), arena.truth)])


def test_the_codes_of_robots_change_no_calibration_of_a_plain_wand():
    arena = ring(4)
    messages = record(arena, 3.0)
    alone, beside = (
        calibrate(arena.intrinsics, WAND, given) for given in (messages, beside_a_robot(messages))
    )
    assert beside.rig == alone.rig


def test_codes_that_the_file_does_not_state_are_named():
    arena = ring(4)
    messages = read_codes(record(arena, 2.0, numbered=True), CODES)
    with pytest.raises(CalibrationError, match=r"codes 3, 40, 77 were left out"):
        calibrate(arena.intrinsics, WAND, messages)


def test_a_wand_with_codes_is_located_in_one_frame_set():
    arena = ring(4, wand=SYMMETRIC)
    messages = read_codes(record(arena, 0.5, numbered=True, free_running=False), CODES)
    latest = {message.camera: message for message in messages if message.t_ns == messages[0].t_ns}
    found = locate_wand(arena.truth.placed(), SYMMETRIC, beside_and_by_name(latest))
    assert found is not None
    assert np.isfinite(found).all()
    span = np.linalg.norm(found - found[0], axis=1)
    assert span == pytest.approx([0, 0.25, 0.5], abs=1e-3)


def beside_and_by_name(latest: dict[str, Detections]) -> dict[str, Detections]:
    return dict(zip(latest, beside_a_robot(list(latest.values())), strict=True))


def test_a_wand_of_which_some_markers_have_codes_is_refused():
    with pytest.raises(ValueError, match="at each of its markers, or at none"):
        msgspec.structs.replace(SYMMETRIC, code=(40, 0, 77))
