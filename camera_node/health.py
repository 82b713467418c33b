# SPDX-License-Identifier: BSD-3-Clause
"""What a camera node says of itself once a second."""

import math
import threading
import time
from pathlib import Path

import numpy as np

from camera_node.messages import CameraStatus
from camera_node.pixels import Grey
from camera_node.source import Frame

THERMAL = Path("/sys/class/thermal")
FULL = 250  # grey levels from which a pixel counts as saturated
SATURATED_SHARE = 0.05
DARK = 64  # grey levels that the brightest hundredth should reach: paper is white
STRIDE = 8  # every eighth pixel each way tells the brightness


class Health:
    """Counts frames, and sums them up once a second."""

    def __init__(self, camera: str) -> None:
        self.camera = camera
        self.refused = 0
        self._lock = threading.Lock()
        self._frames = 0
        self._last: Frame | None = None
        self._clear()

    def _clear(self) -> None:
        self._since = time.monotonic()
        self._recent = self._roundels = 0
        self._detect_us = 0.0

    def count(self, frame: Frame, roundels: int, detect_us: float) -> None:
        """One frame was detected in and published."""
        with self._lock:
            self._frames += 1
            self._recent += 1
            self._roundels += roundels
            self._detect_us += detect_us
            self._last = frame

    def refuse(self) -> None:
        """A request made no sense."""
        with self._lock:
            self.refused += 1

    def status(self, t_ns: int, **known) -> CameraStatus:
        """The status since the last one; `known` are the fields that others know."""
        with self._lock:
            frame, n = self._last, max(1, self._recent)
            brightness = frame.image[::STRIDE, ::STRIDE] if frame else np.empty((0, 0), np.uint8)
            status = CameraStatus(
                camera=self.camera,
                t_ns=t_ns,
                width=frame.image.shape[1] if frame else 0,
                height=frame.image.shape[0] if frame else 0,
                fps=self._recent / max(1e-3, time.monotonic() - self._since),
                frames=self._frames,
                detect_ms=self._detect_us / n / 1000,
                roundels=self._roundels / n,
                saturated=saturated_share(brightness),
                advice=advise(brightness),
                refused=self.refused,
                temperature_c=temperature(),
                **known,
            )
            self._clear()
        return status


def saturated_share(image: Grey) -> float:
    """The share of pixels at the upper end of the grey levels, 0 to 1."""
    return float(np.mean(image >= FULL)) if image.size else 0.0


def advise(image: Grey) -> str:
    """What is wrong with the light: "saturated", "too dark", or nothing."""
    if not image.size:
        return ""
    if saturated_share(image) > SATURATED_SHARE:
        return "saturated"
    return "too dark" if np.percentile(image, 99) < DARK else ""


def temperature(thermal: Path = THERMAL) -> float | None:
    """The hottest zone of this machine, degrees Celsius; None where it has no sensor."""
    degrees = [t for zone in thermal.glob("thermal_zone*/temp") if math.isfinite(t := _degrees(zone))]
    return max(degrees, default=None)


def _degrees(zone: Path) -> float:
    try:
        return int(zone.read_text()) / 1000
    except (OSError, ValueError):
        return math.nan
