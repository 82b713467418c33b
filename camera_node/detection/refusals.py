# SPDX-License-Identifier: BSD-3-Clause
"""Ring-like shapes that a detector refuses, with the test that each of them fails."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from camera_node.detection.detector import Detector, DetectorSettings
from camera_node.detection.roundels import Roundels
from camera_node.foundation.arrays import Array, Grey


class Reason(IntEnum):
    """The test that a ring fails; the numbers are those of `Refusal` in native/verify/acceptance.hpp."""

    NO_FIT, RATIO, CONTRAST, SIZE, CARD, RESIDUALS = range(6)
    EDGES, INSIDE, COVER, BULLSEYE, PALE_INK = range(6, 11)


@dataclass(frozen=True, slots=True)
class RefusedRing:
    """A ring-like shape in an image that does not count as a roundel.

    Attributes:
        uv: (2,) centre of the outer ellipse, raw pixels.
        axes_px: (2,) full major and minor axis.
        angle_rad: direction of the major axis from +u towards +v.
        ratio: inner over outer diameter.
        contrast: bright minus dark, grey levels.
        misfit: RMS residual at the edges over the contrast.
        reason: the first test that it fails.
        text: that test with the measured value and the limit, in a few words.
    """

    uv: Array
    axes_px: Array
    angle_rad: float
    ratio: float
    contrast: float
    misfit: float
    reason: Reason
    text: str


def explain(detector: Detector, image: Grey, found: Roundels) -> list[RefusedRing]:
    """The ring-like shapes of an image that are not among its roundels.

    Args:
        detector: its settings, and what it has learned of the camera, decide.
        image: (h, w), uint8.
        found: the roundels that it detected.
    """
    settings = DetectorSettings(**detector.settings)
    prints = detector.settings["inner_ratios"] or detector.found_ratios
    rings = [_ring(row, settings, prints) for row in detector.measure_rings(image)]
    reach = found.axes_px[:, 0] / 2
    return [ring for ring in rings if not (np.linalg.norm(found.uv - ring.uv, axis=1) < reach).any()]


def _ring(row: Array, settings: DetectorSettings, prints: tuple[float, ...]) -> RefusedRing:
    u, v, major, minor, angle, ratio, contrast, misfit, reason = row.tolist()
    wanted = " or ".join(f"{p:.2f}" for p in prints) or "0.26 to 0.74 (from 14 px on), 0.6 or 0.41"
    sizes = f"{settings.min_diameter_px:g} to {settings.max_diameter_px:g}"
    texts = {
        Reason.NO_FIT: "no roundel fits it: mostly not a ring",
        Reason.RATIO: f"ratio {ratio:.2f}; the prints have {wanted}",
        Reason.CONTRAST: f"contrast {contrast:.0f}; {settings.min_contrast:g} grey levels are needed",
        Reason.SIZE: f"{major:.1f} px; {sizes} are allowed",
        Reason.CARD: "no white around the ring",
        Reason.RESIDUALS: f"edges differ from the model by {100 * misfit:.0f} % of the contrast",
        Reason.EDGES: "edges are not elliptic",
        Reason.INSIDE: "ring or hole are not of one level: text, several rings or glare",
        Reason.COVER: "a part is covered or missing, and the rest does not suffice",
        Reason.BULLSEYE: "further rings around it",
        Reason.PALE_INK: f"thin and pale (contrast {contrast:.0f}): it may be a thinner, black ring",
    }
    kind = Reason(int(reason))
    return RefusedRing(
        np.array([u, v]), np.array([major, minor]), angle, ratio, contrast, misfit, kind, texts[kind]
    )
