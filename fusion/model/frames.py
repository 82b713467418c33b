# SPDX-License-Identifier: BSD-3-Clause
"""Frames as fusion uses them: one camera's, and a set of all cameras'."""

from dataclasses import dataclass
from typing import Any

from calib.rig.camera import Camera
from camera_node.arrays import Array
from camera_node.detection.roundels import Roundels
from camera_node.geometry.lens import Lens
from camera_node.protocol.messages import Detections
from fusion.model.undistortion import undistort


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedFrame:
    """A camera's roundels at `t_ns`, its capture time with the calibrated offset; `sent_ns` and `received_ns` live.

    `xy` (2, N) are their undistorted centres, NaN where the lens has no inverse, and `scale` (2, 2, N) the derivative
    of raw pixels by `xy`: the lens is used here, and nowhere after.
    """

    camera: str
    t_ns: int
    roundels: Roundels
    xy: Array
    scale: Array
    sent_ns: int = 0
    received_ns: int = 0
    exposure_us: float = 0.0
    detect_us: float = 0.0

    @classmethod
    def of(cls, message: Detections, camera: Camera, received_ns: int = 0) -> "CalibratedFrame":
        """The frame that a message of a calibrated camera tells of."""
        return cls.measure(
            message.camera,
            message.t_ns + round(camera.time_offset_ms * 1e6),
            message.unpack(),
            camera,
            sent_ns=message.sent_ns,
            received_ns=received_ns,
            exposure_us=message.exposure_us,
            detect_us=message.detect_us,
        )

    @classmethod
    def measure(
        cls, name: str, t_ns: int, roundels: Roundels, lens: Lens, **arrival: Any
    ) -> "CalibratedFrame":
        """The frame of roundels that a lens saw, and what else is known of its way."""
        return cls(name, t_ns, roundels, *undistort(lens, roundels.uv), **arrival)


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """The frames nearest to `t_ns`, each with a capture time of its own."""

    t_ns: int
    frames: tuple[CalibratedFrame, ...]
