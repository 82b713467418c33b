# SPDX-License-Identifier: BSD-3-Clause
"""What is wrong with a recording, or with a file, is told by name and with what to do."""

import re
from collections.abc import Callable

import msgspec
import pytest

from calib.errors import CalibrationError
from calib.wand.calibrate import calibrate
from camera_node.detection.roundels import Roundels
from camera_node.protocol.messages import Detections
from tests.calib.synthetic import WAND, Arena, record, ring

HOUR_NS, TWO_S_NS = 3_600_000_000_000, 2_000_000_000
Fault = Callable[[Detections], Detections]


def later(by_ns: int) -> Fault:
    return lambda message: msgspec.structs.replace(message, t_ns=message.t_ns + by_ns)


def mirrored(message: Detections) -> Detections:
    """As a webcam's driver does for people who want to see themselves."""
    seen = message.unpack()
    seen.uv[:, 0] = message.width - 1 - seen.uv[:, 0]
    columns = Roundels.from_points(seen.uv, 0.1)
    header = {name: getattr(message, name) for name in ("camera", "seq", "t_ns", "width", "height")}
    return Detections.pack(columns, **header)


def with_fault(messages: list[Detections], fault: Fault) -> list[Detections]:
    return [fault(message) if message.camera == "cam1" else message for message in messages]


FAULTS = [
    (later(HOUR_NS), r"its frames are 35\d\d s later than those of all others.*set it"),
    (later(-TWO_S_NS), r"its stamps are 2\.\d\d s earlier than those of 'cam\d'; set its clock"),
    (mirrored, r"its image is mirrored against that of 'cam\d'; switch the flip off"),
]


@pytest.mark.parametrize(("fault", "says"), FAULTS, ids=["an hour", "two seconds", "mirrored"])
def test_a_camera_with_a_fault_is_left_out_and_told(fault: Fault, says: str):
    """Of four cameras, the others are placed."""
    arena = ring(4)
    messages = with_fault(record(arena, 10.0, sigma_px=0.1, sized=False), fault)
    report = calibrate(arena.intrinsics, arena.wand, messages).report
    assert [row.name for row in report.cameras] == ["cam0", "cam2", "cam3"]
    assert re.search(says, report.unplaced["cam1"])


@pytest.mark.parametrize(("fault", "says"), FAULTS, ids=["an hour", "two seconds", "mirrored"])
def test_of_two_cameras_it_is_the_reason_to_stop(fault: Fault, says: str):
    arena = ring(2)
    messages = with_fault(record(arena, 16.0, sigma_px=0.1, sized=False), fault)
    with pytest.raises(CalibrationError, match=rf"camera 'cam1': {says}"):
        calibrate(arena.intrinsics, arena.wand, messages)


def test_a_wand_at_rest_is_no_wave():
    arena = Arena(ring(3).truth, speed=0.0)
    with pytest.raises(CalibrationError, match=r"hardly moved: by 0\.\d px .* wave it"):
        calibrate(arena.intrinsics, arena.wand, record(arena, 5.0, sigma_px=0.1))


def test_a_wand_with_other_spacings_is_named():
    """The file has the middle roundel 3 cm from where it is: told from which distance, and what it is. Of 6 cm, no two
    cameras fit."""
    arena = ring(4)
    wrong = msgspec.structs.replace(WAND, markers=((0.0, 0.0, 0.0), (0.17, 0.0, 0.0), (0.5, 0.0, 0.0)))
    messages = record(arena, 8.0, sigma_px=0.1, sized=False, numbered=True)
    with pytest.raises(
        CalibrationError, match=r"differs from its file: markers 0 and 1 are 0\.170 m"
    ) as caught:
        calibrate(arena.intrinsics, wrong, messages)
    found = float(str(caught.value).split(" m as the cameras")[0].rsplit(" ", 1)[1])
    assert found == pytest.approx(0.2, abs=0.01)  # scale and spacing share the error
    far_off = msgspec.structs.replace(WAND, markers=((0.0, 0.0, 0.0), (0.14, 0.0, 0.0), (0.5, 0.0, 0.0)))
    with pytest.raises(CalibrationError, match=r"saw the wand at once \d+ times: .* measure it"):
        calibrate(arena.intrinsics, far_off, messages)
