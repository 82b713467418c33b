# SPDX-License-Identifier: BSD-3-Clause
"""Whether a recording can be of the cameras of a rig: their names, the sizes of their images, and where points lie.

Points outside the image show which mistake was made, because one change of the pixels brings all of them inside.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import Camera
from calib.rig.rig import Rig
from calib.wand.quality.checks import MIN_COUNT, MIN_SHARE
from camera_node.foundation.arrays import Array
from camera_node.protocol.messages import Detections


def check_recording(rig: Rig, messages: Sequence[Detections]) -> None:
    """Raise CalibrationError if a recording does not fit the rig, or has fewer than two cameras."""
    sizes = {message.camera: (message.width, message.height) for message in messages}
    check_cameras(rig, messages, "the recording")
    if len(sizes) < 2:
        only = f"one camera, '{next(iter(sizes))}'" if sizes else "no camera"
        raise CalibrationError(f"the recording has {only}; a wand calibration needs two or more")
    for name, (width, height) in sizes.items():
        lens = rig.cameras[name]
        if (width, height) != (lens.width, lens.height):
            raise CalibrationError(
                f"camera '{name}' delivers {width} x {height} pixels, its intrinsics are for "
                f"{lens.width} x {lens.height}; record at that size or calibrate the lens again"
            )
    check_inside(rig, messages, "detections")


def check_cameras(rig: Rig, messages: Sequence[Detections], of: str) -> None:
    """Raise CalibrationError if messages come from a camera that is not in the rig."""
    if unknown := sorted({message.camera for message in messages} - set(rig.cameras)):
        raise CalibrationError(
            f"camera '{unknown[0]}' of {of} is not in the rig, which has "
            f"{', '.join(sorted(rig.cameras))}; name it as there, or run roundel calibrate intrinsics --camera "
            f"{unknown[0]}"
        )


def check_inside(rig: Rig, messages: Sequence[Detections], what: str) -> None:
    """Raise CalibrationError if more than single ones of a camera's points lie outside its image, with the cause."""
    points: dict[str, list[bytes]] = {}
    for message in messages:
        points.setdefault(message.camera, []).append(message.uv)
    for name, parts in points.items():
        uv, camera = np.frombuffer(b"".join(parts), "<f8").reshape(-1, 2), rig.cameras[name]
        outside = int((~camera.sees(uv)).sum())
        if outside < max(MIN_COUNT, MIN_SHARE * len(uv)):
            continue
        (left, top), (right, bottom) = uv.min(axis=0), uv.max(axis=0)
        raise CalibrationError(
            f"{outside / len(uv):.0%} of the {what} of camera '{name}' are outside its image of {camera.width} x "
            f"{camera.height} pixels: they are at u {left:.0f} to {right:.0f}, v {top:.0f} to {bottom:.0f}. "
            + next(_causes(rig, name, uv))
        )


def _causes(rig: Rig, name: str, uv: Array) -> Iterator[str]:
    """Changes that bring the points (n, 2) of a camera into its image, each with what to do, the likeliest first."""
    camera = rig.cameras[name]
    if _holds(camera, uv[:, ::-1]):
        yield (
            "They fit the image turned by 90 degrees: its width and height, or u and v, are exchanged; give the lens "
            "of the image as it was recorded, or exchange u and v"
        )
    if _holds(camera, uv * [1.0, -1.0]):
        yield "They fit if v increases upwards from the top row: write rows from the top down, as 0 to height - 1"
    for other, lens in rig.cameras.items():
        if (lens.width, lens.height) != (camera.width, camera.height) and _holds(lens, uv):
            yield (
                f"They fit the image of '{other}', {lens.width} x {lens.height}: are the names of the cameras "
                "exchanged, or is this the lens of the other one?"
            )
    needed = float((np.quantile(uv + 1.0, 1 - MIN_SHARE / 2, axis=0) / [camera.width, camera.height]).max())
    if needed > 1 and _holds(camera, uv / needed):
        yield (
            f"They fit an image {needed:.2f} times as large, or larger: the lens is that of a smaller image; give "
            "width, height, fx, fy, cx and cy of the image in which the points were found"
        )
    yield "Nothing brings them into the image: are they pixels of this camera?"


def _holds(camera: Camera, uv: Array) -> bool:
    """Whether all of the points (n, 2) but single ones lie in the image."""
    return bool(camera.sees(uv).mean() > 1 - MIN_SHARE)
