# SPDX-License-Identifier: BSD-3-Clause
"""The server's corrections of cameras, as recorded in the `calibration` map of a rig: both the server and its
clients read them."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec
import numpy as np

from calib.rig.camera import Camera
from calib.rig.camera_errors import POSITION
from calib.rig.rig import Rig

CORRECTED = "corrected"  # the entry of the cameras that were corrected last, and when


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

    @property
    def placed(self) -> Mapping[str, Camera]:
        """The cameras that have another pose."""
        return {} if self.camera is None else {self.name: self.camera}


@dataclass(frozen=True, slots=True, eq=False)
class RigRefinement:
    """The poses and lenses of all cameras are known better than by the calibration.

    Attributes:
        rig: all cameras in use, with their errors from now on.
        worst: the camera that was off most.
        off_px: by which its images were off, RMS of a coordinate.
        errors: (8,) by which it was off (`calib.rig.camera_errors`).
    """

    rig: Mapping[str, Camera]
    worst: str
    off_px: float
    errors: tuple[float, ...]

    @property
    def placed(self) -> Mapping[str, Camera]:
        """The cameras that have another pose or lens."""
        return self.rig

    def __str__(self) -> str:
        turn, shift = np.degrees(np.linalg.norm(self.errors[:3])), 1e3 * np.linalg.norm(self.errors[POSITION])
        return (
            f"the rig is refined by up to {self.off_px:.2f} px: camera {self.worst} by {turn:.3f} degrees, "
            f"{shift:.1f} mm and {100 * self.errors[7]:+.2f} % of its focal length"
        )


def correct(rig: Rig, correction: ExtrinsicsCorrection | RigRefinement, t_ns: int) -> Rig:
    """The rig with the cameras that the server recalibrated at `t_ns`."""
    calibration = rig.calibration | {CORRECTED: {"cameras": sorted(correction.placed), "t_ns": t_ns}}
    cameras = {**with_errors_of(rig.cameras, correction.rig), **correction.placed}
    return msgspec.structs.replace(rig, cameras=cameras, calibration=calibration)


def with_errors_of(cameras: Mapping[str, Camera], others: Mapping[str, Camera]) -> dict[str, Camera]:
    """The cameras with the errors (`Camera.errors`) of those of the same names."""
    changed = {
        name: msgspec.structs.replace(camera, errors=others[name].errors)
        for name, camera in cameras.items()
        if name in others
    }
    return {**cameras, **changed}


def corrected_cameras(undone: Rig, restored: Rig) -> list[str]:
    """The cameras whose correction an undo reverts, all of a refinement; none if a user made the change."""
    if undone.calibration.get(CORRECTED) == restored.calibration.get(CORRECTED):
        return []
    return [name for name in _corrected(undone) if name in restored.cameras]


def is_corrected(rig: Rig) -> bool:
    """Whether the server corrected a camera since the calibration."""
    return bool(_corrected(rig))


def _corrected(rig: Rig) -> list[str]:
    entry = rig.calibration.get(CORRECTED)  # from a file or a message: of any type
    names = entry.get("cameras", [entry.get("camera")]) if isinstance(entry, dict) else None
    return [name for name in names if isinstance(name, str)] if isinstance(names, list) else []
