# SPDX-License-Identifier: BSD-3-Clause
"""The server's corrections of moved cameras, as recorded in the `calibration` map of a rig: both the server and its
clients read them."""

from dataclasses import dataclass
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
    """

    name: str
    camera: Camera | None
    has_returned: bool = False


def correct(rig: Rig, name: str, camera: Camera, t_ns: int) -> Rig:
    """The rig with a camera that the server recalibrated at `t_ns`."""
    calibration = rig.calibration | {CORRECTED: {"camera": name, "t_ns": t_ns}}
    return msgspec.structs.replace(rig, cameras={**rig.cameras, name: camera}, calibration=calibration)


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
