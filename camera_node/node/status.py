# SPDX-License-Identifier: BSD-3-Clause
"""What a camera node says of itself once a second."""

import math
import threading
import time
from pathlib import Path

import numpy as np

from camera_node.arrays import Array, Grey
from camera_node.detection.roundels import Roundels
from camera_node.protocol.messages import CameraStatus
from camera_node.sources.frame import Frame

THERMAL = Path("/sys/class/thermal")
FULL = 250  # grey levels from which a pixel counts as saturated
SATURATED_SHARE = 0.05
WHITE = 200  # grey level that white paper should have: bright, with room for what is brighter
DARK = 100  # from here up the white of roundels is bright enough
DARK_GUESSED = 64  # the same of what may be paper: who knows what the picture shows
MOST = 16  # times; more light than that is not a matter of settings
STRIDE = 8  # every eighth pixel each way tells the brightness
NOTHING = np.empty((0, 0), np.uint8), np.empty((0, 2))


class NodeStatistics:
    """Counts frames, and sums them up once a second."""

    def __init__(self, camera: str) -> None:
        self.camera = camera
        self.refused = 0
        self._lock = threading.Lock()
        self._frames = 0
        self._last: tuple[Frame, Roundels] | None = None
        self._clear()

    def _clear(self) -> None:
        self._since = time.monotonic()
        self._recent = self._roundels = 0
        self._detect_us = 0.0

    def count(self, frame: Frame, roundels: Roundels, detect_us: float) -> None:
        """One frame was detected in and published."""
        with self._lock:
            self._frames += 1
            self._recent += 1
            self._roundels += len(roundels)
            self._detect_us += detect_us
            self._last = frame, roundels

    def refuse(self) -> None:
        """A request made no sense."""
        with self._lock:
            self.refused += 1

    def status(self, t_ns: int, **known) -> CameraStatus:
        """The status since the last one; `known` are the fields that others know."""
        with self._lock:
            image, seen = (self._last[0].image, self._last[1].uv) if self._last else NOTHING
            n = max(1, self._recent)
            status = CameraStatus(
                camera=self.camera,
                t_ns=t_ns,
                width=image.shape[1],
                height=image.shape[0],
                fps=self._recent / max(1e-3, time.monotonic() - self._since),
                frames=self._frames,
                detect_ms=self._detect_us / n / 1000,
                roundels=self._roundels / n,
                saturated=saturated_share(image[::STRIDE, ::STRIDE]),
                advice=advise(image, seen),
                refused=self.refused,
                temperature_c=temperature(),
                **known,
            )
            self._clear()
        return status


def saturated_share(image: Grey) -> float:
    """The share of pixels at the upper end of the grey levels, 0 to 1."""
    return float(np.mean(image >= FULL)) if image.size else 0.0


def advise(image: Grey, uv: Array) -> str:
    """What is wrong with the light, and what to change by how much; nothing where all is well.

    The white in the middle of the roundels at `uv` (N, 2) tells. Where there are none, the histogram does.
    """
    if not image.size:
        return ""
    white, dark = (_white_seen(image, uv), DARK) if len(uv) else (_white_guessed(image), DARK_GUESSED)
    if white >= FULL:
        return "saturated: halve the exposure or the gain"
    if white >= dark:
        return ""
    return f"too dark: {min(MOST, WHITE / max(white, 1.0)):.1f} times the exposure or the gain"


def _white_seen(image: Grey, uv: Array) -> float:
    """The grey level of the white discs in the middle of roundels."""
    h, w = image.shape
    u, v = np.rint(uv).astype(int).T
    return float(np.median(image[v.clip(0, h - 1), u.clip(0, w - 1)]))


def _white_guessed(image: Grey) -> float:
    """The grey level of paper in a picture without roundels: full where too much is, else the brightest hundredth's."""
    sampled = image[::STRIDE, ::STRIDE]
    if saturated_share(sampled) > SATURATED_SHARE:
        return FULL
    return min(float(np.percentile(sampled, 99)), FULL - 1.0)


def temperature(thermal: Path = THERMAL) -> float | None:
    """The hottest zone of this machine, degrees Celsius; None where it has no sensor."""
    degrees = [t for zone in thermal.glob("thermal_zone*/temp") if math.isfinite(t := _degrees(zone))]
    return max(degrees, default=None)


def _degrees(zone: Path) -> float:
    try:
        return int(zone.read_text()) / 1000
    except (OSError, ValueError):
        return math.nan
