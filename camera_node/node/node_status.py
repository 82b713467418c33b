# SPDX-License-Identifier: BSD-3-Clause
"""Statistics of a camera node, and advice about exposure and focus, for its status once per second."""

import math
import threading
import time
from pathlib import Path

import numpy as np

from camera_node.detection.detector import Detector
from camera_node.detection.roundels import DetectedRoundels
from camera_node.detection.sharpness import edge_blur_px
from camera_node.foundation.arrays import Array, Grey
from camera_node.protocol.messages import CameraStatus
from camera_node.sources.frame import Source

THERMAL = Path("/sys/class/thermal")
FULL = 250  # grey levels from which a pixel counts as saturated
SATURATED_SHARE = 0.05  # of the pixels, above which an image without roundels is called saturated
WHITE = 200  # grey level that white paper should have: bright, with room for brighter surfaces
DARK = 100  # least grey level of the roundels' white that is bright enough
DARK_GUESSED = 64  # the same where no roundel is seen and the paper's grey level is a guess
MAX_FACTOR = 16  # largest change of exposure that is advised; darker scenes need more light
STRIDE = 8  # the brightness is that of every eighth pixel in both directions
BLURRED_PX = 1.4  # of edges; a camera in focus has 0.4 to 1, and beyond 1.4 small roundels are lost first
NO_IMAGE, NO_CENTRES = np.empty((0, 0), np.uint8), np.empty((0, 2))


class NodeStatistics:
    """Counts frames and refused requests, and summarizes them once per second. Safe to use from several threads.

    Attributes:
        latest: the image and the roundels of the last counted frame; None before the first.
    """

    def __init__(self, camera: str) -> None:
        self.camera = camera
        self.latest: tuple[Grey, DetectedRoundels] | None = None
        self._lock = threading.Lock()
        self._frames = self._refused = 0
        self._clear()

    def _clear(self) -> None:
        self._since = time.monotonic()
        self._recent = self._roundels = 0
        self._detect_us = 0.0

    def count(self, image: Grey, roundels: DetectedRoundels, detect_us: float) -> None:
        """Count a published frame: its roundels as measured, and the duration of their detection."""
        with self._lock:
            self._frames += 1
            self._recent += 1
            self._roundels += len(roundels)
            self._detect_us += detect_us
            self.latest = image, roundels

    def count_refusal(self) -> None:
        """Count a refused request, or a refused message of the server."""
        with self._lock:
            self._refused += 1

    def summarize(
        self, t_ns: int, clock: tuple[int, float] | None, source: Source, detector: Detector
    ) -> CameraStatus:
        """Build the status of the time since the last call.

        Args:
            t_ns: the time of the status, server's time.
            clock: the server's time minus this machine's and the bound of its error, ns; None where unknown.
            source: the source of the frames.
            detector: the detector in use, for what it has learned.
        """
        latest = self.latest
        image, uv = (latest[0], latest[1].uv) if latest else (NO_IMAGE, NO_CENTRES)
        blur_px = edge_blur_px(*latest) if latest else None
        advice = advise(image, uv) or advise_focus(blur_px)
        with self._lock:  # which frames wait for
            n = max(1, self._recent)
            status = CameraStatus(
                camera=self.camera,
                t_ns=t_ns,
                width=image.shape[1],
                height=image.shape[0],
                fps=self._recent / max(1e-3, time.monotonic() - self._since),
                frames=self._frames,
                dropped=source.dropped,
                incomplete=source.incomplete,
                lost_packets=source.lost_packets,
                detect_ms=self._detect_us / n / 1000,
                roundels=self._roundels / n,
                threshold=detector.threshold,
                found_ratios=detector.found_ratios,
                tone_exponent=detector.tone_exponent,
                saturated=saturated_share(image[::STRIDE, ::STRIDE]),
                exposure_us=source.exposure_us,
                gain=source.gain,
                clock_offset_ms=clock[0] / 1e6 if clock else None,
                clock_error_ms=clock[1] / 1e6 if clock else None,
                temperature_c=temperature(),
                edge_blur_px=blur_px,
                advice=advice,
                refused=self._refused,
            )
            self._clear()
        return status


def saturated_share(image: Grey) -> float:
    """The share of pixels at the upper end of the grey levels, 0 to 1."""
    return float(np.mean(image >= FULL)) if image.size else 0.0


def advise(image: Grey, uv: Array) -> str:
    """Advise how to change the exposure; empty where the brightness is right.

    Uses the white in the middle of the roundels at `uv` (N, 2) pixels, or the histogram where there are no roundels.
    """
    if not image.size:
        return ""
    white, dark = (_white_of(image, uv), DARK) if len(uv) else (_guess_white(image), DARK_GUESSED)
    if white >= FULL:
        return "saturated: halve the exposure or the gain"
    if white >= dark:
        return ""
    return f"too dark: {min(MAX_FACTOR, WHITE / max(white, 1.0)):.1f} times the exposure or the gain"


def advise_focus(blur_px: float | None) -> str:
    """Advise to focus the lens if the roundels' edges are blurred, pixels; empty where they are sharp or unknown."""
    if blur_px is None or blur_px < BLURRED_PX:
        return ""
    return f"out of focus: edges are blurred by {blur_px:.1f} px; turn the focus ring until that is least"


def _white_of(image: Grey, uv: Array) -> float:
    """The median grey level of the white discs in the middle of the roundels."""
    h, w = image.shape
    u, v = np.rint(uv).astype(int).T
    return float(np.median(image[v.clip(0, h - 1), u.clip(0, w - 1)]))


def _guess_white(image: Grey) -> float:
    """The grey level of paper in an image without roundels: the 99th percentile, or `FULL` where many are saturated."""
    sampled = image[::STRIDE, ::STRIDE]
    if saturated_share(sampled) > SATURATED_SHARE:
        return FULL
    return min(float(np.percentile(sampled, 99)), FULL - 1.0)


def temperature(thermal: Path = THERMAL) -> float | None:
    """The temperature of this machine's hottest zone, degrees Celsius; None without a sensor."""
    degrees = [t for zone in thermal.glob("thermal_zone*/temp") if math.isfinite(t := _degrees(zone))]
    return max(degrees, default=None)


def _degrees(zone: Path) -> float:
    try:
        return int(zone.read_text()) / 1000
    except (OSError, ValueError):
        return math.nan
