# SPDX-License-Identifier: BSD-3-Clause
"""Figures of common cameras, so that a plan can name one instead of giving its sensor and lens.

Figures are those of the sources, for the fastest mode that reads the whole field of view at a useful resolution. A
binned mode has a multiple of the sensor's pixel pitch.
"""

from dataclasses import dataclass
from typing import Literal

from camera_node.foundation.errors import ConfigError

RPI = "Raspberry Pi documentation, Camera hardware: table of camera modules"
LUXONIS = "Luxonis documentation, Camera sensors"
BASLER = "Basler product documentation, docs.baslerweb.com"


@dataclass(frozen=True, slots=True)
class CatalogueCamera:
    """A camera or a sensor on a board.

    Attributes:
        what: what it is, for people.
        width, height: of its image, pixels.
        pitch_um: distance of two pixels of this image on the sensor, micrometres.
        fps: frames per second in this mode.
        shutter: a rolling shutter reads the rows one after another, during up to a frame.
        focal_mm: of its lens, or of a usual lens where the lens can be changed.
        changeable: whether another lens fits.
        source: of the figures.
        model: "fisheye" for a lens whose image height grows with the angle (r = f theta).
    """

    what: str
    width: int
    height: int
    pitch_um: float
    fps: float
    shutter: Literal["global", "rolling"]
    focal_mm: float
    changeable: bool
    source: str
    model: Literal["pinhole", "fisheye"] = "pinhole"


CATALOGUE = {
    "mt9v032": CatalogueCamera(
        "the paper's module, lens of 42 degrees", 752, 480, 6.0, 60, "global", 5.88, True,
        "Faigl et al., ICRA 2013, Section III; MT9V032 data sheet",
    ),
    "ov9281": CatalogueCamera(
        "1 MP board with an M12 lens of 2.8 mm", 1280, 800, 3.0, 120, "global", 2.8, True,
        f"OV9281 data sheet 1.22; {LUXONIS}, OV9282",
    ),
    "oak-d": CatalogueCamera(
        "OV9282 of a stereo camera, 80 degrees", 1280, 800, 3.0, 120, "global", 2.35, False,
        f"{LUXONIS}, OV9282, NFOV module",
    ),
    "oak-d-wide": CatalogueCamera(
        "OV9282 of a stereo camera, 127 degrees", 1280, 800, 3.0, 120, "global", 1.69, False,
        f"{LUXONIS}, OV9282, WFOV module", "fisheye",
    ),
    "ar0234": CatalogueCamera(
        "2.3 MP board with an M12 lens of 4 mm", 1920, 1200, 3.0, 60, "global", 4.0, True,
        f"{LUXONIS}, AR0234",
    ),
    "rpi-gs": CatalogueCamera(
        "Raspberry Pi Global Shutter (IMX296), lens of 6 mm", 1456, 1088, 3.45, 60, "global", 6.0, True, RPI,
    ),
    "rpi-3": CatalogueCamera(
        "Raspberry Pi Camera Module 3 (IMX708), binned", 2304, 1296, 2.8, 56, "rolling", 4.74, False, RPI,
    ),
    "rpi-3-wide": CatalogueCamera(
        "Raspberry Pi Camera Module 3 Wide (IMX708), binned", 2304, 1296, 2.8, 56, "rolling", 2.75, False, RPI,
    ),
    "rpi-2": CatalogueCamera(
        "Raspberry Pi Camera Module 2 (IMX219), binned", 1640, 1232, 2.24, 41, "rolling", 3.04, False, RPI,
    ),
    "rpi-hq": CatalogueCamera(
        "Raspberry Pi HQ (IMX477), binned, lens of 6 mm", 2028, 1520, 3.1, 40, "rolling", 6.0, True, RPI,
    ),
    "imx273": CatalogueCamera(
        "1.6 MP industrial camera, lens of 4 mm", 1440, 1080, 3.45, 227, "global", 4.0, True,
        f"{BASLER}, acA1440-220uc",
    ),
    "imx392": CatalogueCamera(
        "2.3 MP industrial camera, lens of 4 mm", 1920, 1200, 3.45, 164, "global", 4.0, True,
        f"{BASLER}, daA1920-160um",
    ),
    "imx252": CatalogueCamera(
        "3.2 MP industrial camera, lens of 6 mm", 2048, 1536, 3.45, 118, "global", 6.0, True,
        "FLIR Blackfly S BFS-U3-32S4 specification",
    ),
    "imx250": CatalogueCamera(
        "5 MP industrial camera, lens of 6 mm", 2464, 2056, 3.45, 76, "global", 6.0, True,
        "Teledyne DALSA Genie Nano manual, M2450",
    ),
}  # fmt: skip


def find_camera(name: str) -> CatalogueCamera:
    """The camera of the catalogue with this name.

    Raises:
        ConfigError: there is none.
    """
    if name not in CATALOGUE:
        raise ConfigError(f"the catalogue has no camera '{name}'; it has {', '.join(CATALOGUE)}")
    return CATALOGUE[name]
