# SPDX-License-Identifier: BSD-3-Clause
"""What a recording contradicts is named, and undoing it cures the recording."""

import re
from collections.abc import Sequence
from functools import cache

import msgspec
import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.rig.rig import Rig
from calib.wand.calibrate import calibrate
from camera_node.foundation.arrays import Array
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from tests.calib.mishaps import altered, repack
from tests.calib.recordings import SimulatedRecording, WandScenario
from tests.calib.recordings import record as record_wave
from tests.calib.synthetic import STICK, WAND, Arena, camera_errors, record, ring

BODY = Body(diameter_m=0.05, markers=((0, 0, 0), (0.3, 0, 0), (0, 0.2, 0), (0, 0, 0.25)))


@cache
def wave(wand: Body = STICK) -> SimulatedRecording:
    """Ten seconds of four synchronous cameras whose lenses have their centres up to 15 px from those of the images."""
    return record_wave(
        WandScenario(
            cameras=4,
            arc=0.5,
            seconds=10,
            rate_hz=10,
            wand=wand,
            numbered=True,
            sized=False,
            both_sides=True,
            free_running=False,
            offset_ms=0.0,
            drift_ppm=0.0,
        )
    )


def mirrored(messages: Sequence[Detections], axis: int) -> list[Detections]:
    """Flip the images of all cameras left to right (axis 0), or top to bottom."""

    def flip(m: Detections, uv: Array) -> Array:
        flipped = uv.copy()
        flipped[:, axis] = (m.width, m.height)[axis] - 1 - uv[:, axis]
        return flipped

    return [repack(m, altered(seen, uv=flip(m, seen.uv))) for m in messages for seen in [m.unpack()]]


@pytest.mark.parametrize(("axis", "how"), [(0, "left to right"), (1, "top to bottom")])
def test_images_that_are_all_mirrored_are_refused_by_their_lenses(axis: int, how: str):
    recorded = wave()
    wrong = mirrored(recorded.messages, axis)
    with pytest.raises(CalibrationError, match=rf"all cameras are mirrored {how}: .* replace [uv] by"):
        calibrate(recorded.intrinsics, STICK, wrong, synchronous=True)
    for cured, m in zip(mirrored(wrong, axis), recorded.messages, strict=True):
        assert cured.unpack().uv == pytest.approx(m.unpack().uv)


def test_images_that_are_not_mirrored_are_calibrated():
    recorded = wave()
    result = calibrate(recorded.intrinsics, STICK, recorded.messages, synchronous=True)
    assert camera_errors(result.rig, recorded.truth)[0].max() < 5e-3


def test_lenses_with_their_centre_in_the_middle_do_not_tell_mirrored_images():
    """Nothing in these files differs between the two: no mirrored image may be claimed."""
    recorded = wave()
    middle = {
        name: lens.with_parameters([*lens.parameters[:2], 639.5, 399.5, *lens.parameters[4:]])
        for name, lens in recorded.intrinsics.cameras.items()
    }
    assert len(calibrate(Rig(cameras=middle), STICK, recorded.messages, synchronous=True).names) == 4


@pytest.mark.ci
def test_a_wand_that_is_not_flat_shows_mirrored_images():
    recorded = wave(BODY)
    with pytest.raises(CalibrationError, match=r"markers are mirrored against its file: .* disable the flip"):
        calibrate(recorded.intrinsics, BODY, mirrored(recorded.messages, 0), synchronous=True)
    opposite = Body(diameter_m=0.05, markers=tuple((x, y, -z) for x, y, z in BODY.markers))
    with pytest.raises(CalibrationError, match="correct the signs of one axis in the wand file"):
        calibrate(recorded.intrinsics, opposite, recorded.messages, synchronous=True)
    assert len(calibrate(recorded.intrinsics, BODY, recorded.messages, synchronous=True).names) == 4


def moved_half_way(arena: Arena, shifts: dict[str, tuple[float, float, float]]) -> list[Detections]:
    """Sixteen seconds in which cameras are moved by vectors, metres, after eight."""
    cameras = dict(arena.truth.cameras)
    for name, shift in shifts.items():
        pose = cameras[name].T_world_cam
        assert pose is not None
        x, y, z = np.add(pose.position_m, shift).tolist()
        cameras[name] = msgspec.structs.replace(
            cameras[name], T_world_cam=msgspec.structs.replace(pose, position_m=(x, y, z))
        )
    options = {"sigma_px": 0.1, "numbered": True, "sized": False}
    before, after = record(arena, 16.0, **options), record(Arena(Rig(cameras=cameras)), 16.0, **options)
    return [m for m in before if m.seq < 80] + [m for m in after if m.seq >= 80]


@pytest.mark.ci
def test_a_camera_that_moves_is_named_with_the_time():
    arena = ring()
    report = calibrate(arena.intrinsics, WAND, moved_half_way(arena, {"cam2": (0.0, 0.3, -0.3)})).report
    assert list(report.unplaced) == ["cam2"]
    at = re.search(r"at ([0-9.]+) s of the recording it moved by (0\.\d+) of", report.unplaced["cam2"])
    assert at is not None
    assert float(at[1]) == pytest.approx(8.0, abs=0.3)
    assert float(at[2]) == pytest.approx(0.3 * 2**0.5, rel=0.1)


@pytest.mark.ci
def test_cameras_that_contradict_each_other_are_refused():
    """Two of four move: nothing is written. The first half of the recording is calibrated, as the message says."""
    arena = ring()
    messages = moved_half_way(arena, {"cam2": (0.0, 0.3, -0.3), "cam3": (0.3, 0.0, 0.2)})
    with pytest.raises(CalibrationError, match=r"contradicts every rig .* second half of the recording"):
        calibrate(arena.intrinsics, WAND, messages)
    assert len(calibrate(arena.intrinsics, WAND, [m for m in messages if m.seq < 80]).names) == 4
