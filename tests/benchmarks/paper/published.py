# SPDX-License-Identifier: BSD-3-Clause
"""The figures that Faigl, Krajnik, Chudoba and Saska (ICRA 2013) measured, by their tables, and their camera."""

from dataclasses import dataclass

import numpy as np

from camera_node.geometry.lens import Lens
from camera_node.sensor_model.operational_space import Pattern

RESOLUTIONS = ((320, 240), (480, 360), (640, 480), (752, 480))
PATTERN = Pattern(0.14, 0.084, 0.18)  # of Sections V-A to V-C

# The sensor has 752 x 480 pixels. The paper states a smallest field of view of 42 degrees, and 0.96 m for half of v_z
# at 3 m, 360 lines: f_y = 3 * 360 / (2 * 0.96 + 2 * 0.14) = 491 px, which is 655 px at 480 lines and 40 degrees.
SENSOR, FOCAL_PX = (752, 480), 655.0
# Barrel distortion that widens the 3.2 m of this focal length to about the 4 m that were measured at 3 m.
DISTORTION = (-0.30, 0.08, 0.0, 0.0)


def paper_lens(resolution: tuple[int, int]) -> Lens:
    """The camera at one resolution: the whole field of the sensor, so f_x and f_y differ."""
    w, h = resolution
    fx, fy = FOCAL_PX * w / SENSOR[0], FOCAL_PX * h / SENSOR[1]
    return Lens(width=w, height=h, fx=fx, fy=fy, cx=(w - 1) / 2, cy=(h - 1) / 2, distortion=DISTORTION)


@dataclass(frozen=True)
class Speed:
    """A row of Table II: largest distance in metres, and frames per second searching and tracking."""

    l_max: float
    search: float
    tracking: float


TABLE_2 = {
    (320, 240): Speed(3.2, 33, 60),
    (480, 360): Speed(3.5, 18, 46),
    (640, 480): Speed(5.5, 9, 30),
    (752, 480): Speed(5.5, 7, 27),
}

DISTANCES = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.2, 3.5, 4.0, 4.5, 5.0, 5.5)
# Table III: error L_e in cm after the systematic error was identified, and repeatability L_delta in % of the distance.
_L_E = {
    (320, 240): (1.2, 0.1, 0.6, 0.2, 2.0, 1.2, 3.0),
    (480, 360): (0.9, 0.3, 0.9, 1.0, 0.0, 0.7, 1.8, 1.8),
    (640, 480): (3.6, 1.5, 0.1, 1.1, 0.7, 0.0, 3.5, 0.8, 5.4, 2.7, 2.4, 6.6),
    (752, 480): (4.3, 2.3, 0.4, 0.8, 1.8, 4.0, 2.3, 2.2, 3.3, 2.5, 3.4, 6.5),
}
_L_DELTA = {
    (320, 240): (0.1, 0.1, 0.1, 0.5, 0.2, 0.2, 0.2),
    (480, 360): (0.4, 0.1, 0.1, 0.1, 0.2, 0.3, 0.7, 0.9),
    (640, 480): (0.6, 0.3, 0.1, 0.1, 0.2, 0.2, 0.2, 0.2, 0.4, 0.3, 0.6, 0.5),
    (752, 480): (1.2, 0.6, 0.5, 0.1, 0.2, 0.2, 0.2, 0.2, 0.4, 0.2, 0.6, 0.7),
}


def table_3(resolution: tuple[int, int]) -> dict[float, tuple[float, float]]:
    """L_e in cm and L_delta in % by distance in metres."""
    pairs = zip(_L_E[resolution], _L_DELTA[resolution], strict=True)
    return dict(zip(DISTANCES, pairs, strict=False))


# Table IV: the largest distance in metres, L_e in cm and L_delta in % of each resolution, as printed.
TABLE_4 = {
    (320, 240): (3.2, 3.0, 0.5),
    (480, 360): (3.5, 1.8, 0.7),
    (640, 480): (5.5, 6.6, 0.6),
    (752, 480): (5.5, 6.5, 0.6),
}

# Table V: largest distance in metres by pattern.
PATTERNS = {
    "A": Pattern(0.035, 0.021, 0.055),
    "B": Pattern(0.035, 0.021, 0.075),
    "C": Pattern(0.060, 0.036, 0.080),
    "D": Pattern(0.070, 0.042, 0.090),
}
TABLE_5 = {
    (320, 240): (0.5, 0.5, 1.0, 1.0),
    (480, 360): (0.5, 1.0, 1.5, 2.0),
    (640, 480): (1.0, 1.2, 2.5, 2.5),
    (752, 480): (1.4, 1.5, 2.5, 2.5),
}

# Section V-C: a wall at 3 m, 480 x 360 pixels. Largest height z by horizontal position y, metres, and the whole area.
WALL_M, WALL_RESOLUTION = 3.0, (480, 360)
WALL_TOP = {0.0: 0.9, -0.5: 1.0, 1.0: 1.1}
WALL_WIDTH, WALL_HEIGHT = 4.0, 2.0


def vertical_field_deg() -> float:
    """The vertical field of view of this focal length without distortion."""
    return float(np.degrees(2 * np.arctan(SENSOR[1] / 2 / FOCAL_PX)))
