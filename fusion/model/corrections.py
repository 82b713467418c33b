# SPDX-License-Identifier: BSD-3-Clause
"""The server's corrections of moved cameras, as recorded in the `calibration` map of a rig: both the server and its
clients read them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec

from calib.rig.camera import Camera
from calib.rig.rig import Rig

CORRECTED = "corrected"  # the entry of the camera that was corrected last


@dataclass(frozen=True, slots=True, eq=False)
class ExtrinsicsCorrection:
    """A camera was moved.

    Attributes:
        name: of the camera.
        camera: with the pose with which it is used again; None when it is excluded.
        has_returned: whether that pose is the one in use, or one before.
        rig: all cameras in use with their errors (`Camera.errors`) from now on; empty where these stay.
    """

    name: str
    camera: Camera | None
    has_returned: bool = False
    rig: Mapping[str, Camera] = field(default_factory=dict)


def correct(rig: Rig, correction: ExtrinsicsCorrection, t_ns: int) -> Rig:
    """The rig with a camera that the server recalibrated at `t_ns`."""
    calibration = rig.calibration | {CORRECTED: {"camera": correction.name, "t_ns": t_ns}}
    cameras = with_errors_of(rig.cameras, correction.rig)
    if correction.camera is not None:
        cameras[correction.name] = correction.camera
    return msgspec.structs.replace(rig, cameras=cameras, calibration=calibration)


def with_errors_of(cameras: Mapping[str, Camera], others: Mapping[str, Camera]) -> dict[str, Camera]:
    """The cameras with the errors (`Camera.errors`) of those of the same names."""
    changed = {
        name: msgspec.structs.replace(camera, errors=others[name].errors)
        for name, camera in cameras.items()
        if name in others
    }
    return {**cameras, **changed}


def corrected_camera(undone: Rig, restored: Rig) -> str | None:
    """The camera whose correction an undo reverts; None if a user made the change."""
    was, name = _correction(undone), _correction(undone).get("camera")
    return name if was != _correction(restored) and name in restored.cameras else None


def is_corrected(rig: Rig) -> bool:
    """Whether the server corrected a camera since the calibration."""
    return bool(_correction(rig))


def _correction(rig: Rig) -> dict[str, Any]:
    entry = rig.calibration.get(CORRECTED)  # from a file or a message: of any type
    return entry if isinstance(entry, dict) and isinstance(entry.get("camera"), str) else {}
