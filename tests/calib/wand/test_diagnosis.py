# SPDX-License-Identifier: BSD-3-Clause
"""A camera with a wrong clock or a mirrored image is excluded, with the fault, its size and the remedy."""

import re
from collections.abc import Callable

import msgspec
import pytest

from calib.errors import CalibrationError
from calib.wand.calibrate import calibrate
from camera_node.detection.roundels import Roundels
from camera_node.protocol.messages import Detections
from tests.calib.mishaps import repack
from tests.calib.synthetic import record, ring

HOUR_NS, TWO_S_NS = 3_600_000_000_000, 2_000_000_000
Fault = Callable[[Detections], Detections]


def later(by_ns: int) -> Fault:
    return lambda message: msgspec.structs.replace(message, t_ns=message.t_ns + by_ns)


def mirrored(message: Detections) -> Detections:
    """Flip the image left to right, as some webcam drivers do."""
    seen = message.unpack()
    seen.uv[:, 0] = message.width - 1 - seen.uv[:, 0]
    return repack(message, Roundels.from_points(seen.uv, 0.1))


def with_fault(messages: list[Detections], fault: Fault) -> list[Detections]:
    return [fault(message) if message.camera == "cam1" else message for message in messages]


FAULTS = [
    (later(HOUR_NS), r"35\d\d s later than .*set its clock"),
    (later(-TWO_S_NS), r"2\.\d\d s earlier than .*'cam\d'; set its clock"),
    (mirrored, r"mirrored .*'cam\d'; disable the flip"),
]


@pytest.mark.parametrize(("fault", "states"), FAULTS, ids=["an hour", "two seconds", "mirrored"])
def test_a_camera_with_a_fault_is_excluded_and_named(fault: Fault, states: str):
    """The other three of four cameras are placed."""
    arena = ring(4)
    messages = with_fault(record(arena, 10.0, sigma_px=0.1, sized=False), fault)
    report = calibrate(arena.intrinsics, arena.wand, messages).report
    assert [row.name for row in report.cameras] == ["cam0", "cam2", "cam3"]
    assert re.search(states, report.unplaced["cam1"])


@pytest.mark.parametrize(("fault", "states"), FAULTS, ids=["an hour", "two seconds", "mirrored"])
def test_a_fault_of_one_of_two_cameras_is_the_error(fault: Fault, states: str):
    arena = ring(2)
    messages = with_fault(record(arena, 16.0, sigma_px=0.1, sized=False), fault)
    with pytest.raises(CalibrationError, match=rf"camera 'cam1': .*{states}"):
        calibrate(arena.intrinsics, arena.wand, messages)
