# SPDX-License-Identifier: BSD-3-Clause
"""Frames of calibrated cameras, and frame sets."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.rig.camera import Camera
from camera_node.detection.roundels import Roundels
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.lens import Lens
from camera_node.protocol.messages import Detections
from fusion.model.undistortion import UV, columns_of, undistort

MAX_CLOCK_ERROR_S = 0.1  # a stamp with a larger bound has this one; NaN is an unknown bound


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedFrame:
    """The roundels of one frame, undistorted. No later step uses the lens model.

    Attributes:
        t_ns: capture time including the calibrated offset of the camera.
        detected: what the camera sent, or the roundels of a simulation.
        columns: (19, N) of a `DetectionTable`, without the errors of cameras and without delays.
        stamp_ns: capture time as the camera published it; 0 without a message.
        sent_ns, received_ns: times of the message; 0 offline.
        exposure_us, detect_us: durations; 0 where unknown.
        clock_sigma_s: standard deviation of `t_ns` by the clock, which frames have in common.
        stamp_sigma_s: by errors of single stamps.
        readout_s: time in which a rolling shutter reads all rows, see `Detections`; `t_ns` is that of the middle.
    """

    camera: str
    t_ns: int
    detected: Detections | Roundels
    columns: Array
    stamp_ns: int = 0
    sent_ns: int = 0
    received_ns: int = 0
    exposure_us: float = 0.0
    detect_us: float = 0.0
    clock_sigma_s: float = 0.0
    stamp_sigma_s: float = 0.0
    readout_s: float = 0.0

    @classmethod
    def of(cls, message: Detections, camera: Camera, received_ns: int = 0) -> "CalibratedFrame":
        """The frame of a message from a calibrated camera."""
        return cls.measure(
            message.camera,
            camera.capture_ns(message.t_ns, message.sent_ns),
            message,
            camera,
            stamp_ns=message.t_ns,
            sent_ns=message.sent_ns,
            received_ns=received_ns,
            exposure_us=message.exposure_us,
            detect_us=message.detect_us,
            clock_sigma_s=clock_sigma_s(message.clock_error_us),
            readout_s=camera.readout_s(message.readout_us),
        )

    @classmethod
    def measure(
        cls, name: str, t_ns: int, detected: Detections | Roundels, lens: Lens, **timing: Any
    ) -> "CalibratedFrame":
        """The frame of roundels from the camera `name` with this lens; `timing` sets the remaining fields."""
        return cls(name, t_ns, detected, undistort(lens, columns_of(detected)), **timing)

    @property
    def roundels(self) -> Roundels:
        """As they were detected."""
        return self.detected.unpack() if isinstance(self.detected, Detections) else self.detected

    @property
    def time_sigma_s(self) -> float:
        """Standard deviation of `t_ns`."""
        return math.hypot(self.clock_sigma_s, self.stamp_sigma_s)

    def select(self, rows: Index) -> "CalibratedFrame":
        """The frame with some of its roundels."""
        return replace(self, detected=self.roundels.select(rows), columns=self.columns[:, rows])

    def recalibrated(self, old: Camera, new: Camera) -> "CalibratedFrame":
        """The frame by another calibration of its camera."""
        stamp_ns = self.stamp_ns or self.t_ns
        before_ns, after_ns = (camera.capture_ns(stamp_ns, self.sent_ns) for camera in (old, new))
        columns = undistort(new, self.columns.copy(), added_px2=0.0)
        return replace(self, t_ns=self.t_ns + after_ns - before_ns, columns=columns)

    def delays(self, lens: Lens) -> Array:
        """(N,) times from `t_ns` to the capture of each roundel's row, seconds."""
        if not self.readout_s:
            return np.zeros(self.columns.shape[1])
        return self.readout_s * lens.image_row(self.columns[UV].T)


def clock_sigma_s(error_us: float) -> float:
    """The standard deviation of a stamp with this bound of its error, s; the largest one where none is known."""
    bound_s = error_us * 1e-6 if 0 <= error_us < MAX_CLOCK_ERROR_S * 1e6 else MAX_CLOCK_ERROR_S
    return bound_s / 3**0.5  # of a uniform distribution


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """Frames of all cameras near `t_ns`, each with its own capture time.

    Attributes:
        judged: of a recording: how many judgements of the cameras, which run beside tracking, the server took after
            this frame set. Where it is None, they are taken at once.
    """

    t_ns: int
    frames: tuple[CalibratedFrame, ...]
    judged: int | None = None
