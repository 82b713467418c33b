# SPDX-License-Identifier: BSD-3-Clause
"""What a camera node reads of the calibration in force: the lenses of the cameras."""

from typing import ClassVar

import msgspec

from camera_node.geometry.lens import Lens
from camera_node.protocol.messages import VERSION


class RigLenses(msgspec.Struct, frozen=True, kw_only=True):
    """The lenses in a `RigMessage`, which `calib` defines and the server publishes; other fields are skipped."""

    class Cameras(msgspec.Struct, frozen=True):
        """The part of a rig."""

        cameras: dict[str, Lens]

    MAX_BYTES: ClassVar[int] = 1 << 20  # that of a `RigMessage`
    version: int = VERSION
    rig: Cameras
