# SPDX-License-Identifier: BSD-3-Clause
"""Points outside the image are refused with the mistake that explains them, and undoing it cures the recording."""

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.rig.rig import Rig
from calib.wand.calibrate import calibrate
from calib.wand.recording_checks import check_recording
from camera_node.foundation.arrays import Array
from camera_node.protocol.messages import Detections
from tests.calib.mishaps import altered, repack
from tests.calib.synthetic import WAND, record, ring

Move = Callable[[Array], Array]


def moved(messages: list[Detections], move: Move, names: tuple[str, ...] = ("cam1",)) -> list[Detections]:
    """The recording with the pixels of some cameras moved."""
    seen = [(m, m.unpack()) for m in messages]
    return [repack(m, altered(s, uv=move(s.uv))) if m.camera in names else m for m, s in seen]


@pytest.mark.parametrize(
    ("mistake", "undo", "cause"),
    [
        (
            lambda uv: 3 * uv,
            lambda uv: uv / 3,
            r"an image (1\.[5-9]|[23]\.\d)\d times as large, .*fx, fy, cx",
        ),
        (lambda uv: uv * [1, -1], lambda uv: uv * [1, -1], "v increases upwards from the top row"),
        (lambda uv: uv[:, ::-1], lambda uv: uv[:, ::-1], "turned by 90 degrees: .* exchange u and v"),
        (lambda uv: uv + 9e4, lambda uv: uv - 9e4, "Nothing brings them into the image"),
    ],
    ids=["scaled", "upwards", "turned", "nonsense"],
)
def test_points_outside_the_image_have_a_cause(mistake: Move, undo: Move, cause: str):
    arena = ring(2)
    wrong = moved(record(arena, 30.0, numbered=True, sized=False), mistake)
    with pytest.raises(CalibrationError, match=rf"detections of camera 'cam1' are outside .* {cause}"):
        calibrate(arena.intrinsics, WAND, wrong)
    check_recording(arena.intrinsics, moved(wrong, undo))


def test_the_lens_of_a_camera_with_another_image_is_named():
    """cam1 has twice the pixels; the rig file has the lens of cam0 for it, and the other way round."""
    arena = ring(2)
    first, second = arena.truth.cameras["cam0"], arena.truth.cameras["cam1"]
    large = second.with_parameters(np.multiply(second.parameters, [2, 2, 2, 2, *[1] * 5]))
    large = msgspec.structs.replace(large, width=1600, height=1200)
    messages = moved(record(arena, 30.0, numbered=True, sized=False), lambda uv: 2 * uv + 0.5)
    # A table of points has no image sizes: messages have those of the rig.
    stated = [msgspec.structs.replace(m, width=800, height=600) for m in messages]
    with pytest.raises(CalibrationError, match=r"image of 'cam0', 1600 x 1200: are the names"):
        check_recording(
            Rig(cameras={"cam0": large, "cam1": first}),
            [
                msgspec.structs.replace(m, width=1600, height=1200) if m.camera == "cam0" else m
                for m in stated
            ],
        )
    check_recording(
        Rig(cameras={"cam0": first, "cam1": large}),
        [msgspec.structs.replace(m, width=1600, height=1200) if m.camera == "cam1" else m for m in stated],
    )


def test_single_points_outside_the_image_are_no_mistake():
    """Corners of a tag may lie outside; seven that are wrong by far are rejected, one more is a mistake."""
    arena, count = ring(2), 7
    messages = record(arena, 12.0, sigma_px=0.1, numbered=True, sized=False)
    mine = [k for k, m in enumerate(messages) if m.camera == "cam1" and len(m)][: count + 1]
    for k in mine[:count]:
        messages[k] = nowhere(messages[k])
    result = calibrate(arena.intrinsics, WAND, messages)
    used = result.adjusted.used
    assert result.observations.uv[used].min() > 0
    assert used.sum() > 0.9 * (len(used) - count)
    messages[mine[count]] = nowhere(messages[mine[count]])
    with pytest.raises(CalibrationError, match=r"Nothing brings them into the image|are outside its image"):
        check_recording(arena.intrinsics, messages)


def nowhere(message: Detections) -> Detections:
    """The message with its first point outside the image."""
    seen = message.unpack()
    return repack(message, altered(seen, uv=np.vstack([[-40.0, 20.0], seen.uv[1:]])))
