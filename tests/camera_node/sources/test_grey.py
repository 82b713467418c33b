# SPDX-License-Identifier: BSD-3-Clause
"""Every format that cameras deliver is converted to the same 8-bit grey."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from camera_node.detection.detector import Detector
from camera_node.sources.grey import BAYER, narrow, to_grey
from camera_node.sources.recorded_frames import FrameFolder
from tests.benchmarks.detector.pictures import Card, outline_of, render

LEVELS = np.arange(24, dtype=np.uint8).reshape(4, 6) * 10


def yuyv(image: NDArray) -> NDArray:
    return np.stack([image, np.full_like(image, 128)], axis=-1)


def uyvy(image: NDArray) -> NDArray:
    return yuyv(image)[..., ::-1].copy()


def test_grey_is_not_copied():
    assert np.shares_memory(to_grey(LEVELS), LEVELS)
    assert np.shares_memory(to_grey(LEVELS[::2, 1:4], "GREY"), LEVELS)


def test_the_grey_level_of_yuv_is_its_luma_channel():
    assert np.array_equal(to_grey(yuyv(LEVELS), "YUYV"), LEVELS)
    assert np.array_equal(to_grey(yuyv(LEVELS)), LEVELS)
    assert np.array_equal(to_grey(uyvy(LEVELS), "UYVY"), LEVELS)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_deep_grey_is_scaled_and_rounded(bits: int):
    """Full scale becomes 255, 0 stays 0, and levels in between are right to half a level."""
    full = 2**bits - 1
    deep = np.linspace(0, full, 60).astype(np.uint16).reshape(6, 10)
    narrowed = narrow(deep)
    assert narrowed.dtype == np.uint8
    assert (narrowed[0, 0], narrowed[-1, -1]) == (0, 255)
    assert np.abs(narrowed - deep * (255 / full)).max() <= 0.5 + 1e-6
    assert narrow(np.empty((0, 5), np.uint16)).shape == (0, 5)


@pytest.mark.parametrize(("fourcc", "bits"), [("Y10 ", 10), ("Y12 ", 12)])
def test_a_dark_image_stays_dark_where_the_format_states_its_depth(fourcc: str, bits: int):
    """A quarter of full scale, which could be full scale of two bits fewer."""
    dark = np.full((4, 6), 2 ** (bits - 2) - 1, np.uint16)
    assert np.abs(to_grey(dark, fourcc) - 255 / 4).max() < 1


@pytest.mark.parametrize("fourcc", BAYER)
def test_each_bayer_pattern_has_its_red_pixels_in_place(fourcc: str):
    """One pixel in four of a mosaic of pure red has the level 200; the luma is 0.299 times that (ITU-R BT.601)."""
    at = {"RGGB": (0, 0), "GRBG": (0, 1), "GBRG": (1, 0), "BA81": (1, 1)}[fourcc]
    mosaic = np.zeros((8, 8), np.uint8)
    mosaic[at[0] :: 2, at[1] :: 2] = 200
    assert np.abs(to_grey(mosaic, fourcc)[2:-2, 2:-2] - 0.299 * 200).max() <= 1


def test_colour_becomes_luma():
    """0.114 B + 0.587 G + 0.299 R."""
    assert to_grey(np.full((2, 2, 3), (100, 50, 200), np.uint8)) == pytest.approx(np.full((2, 2), 101), abs=1)


FORMATS: dict[str, tuple[Callable[[NDArray], NDArray], str | None]] = {
    "grey": (lambda i: np.rint(i).astype(np.uint8), None),
    "colour": (lambda i: cv2.cvtColor(np.rint(i).astype(np.uint8), cv2.COLOR_GRAY2BGR), None),
    "YUYV": (lambda i: yuyv(np.rint(i).astype(np.uint8)), "YUYV"),
    "UYVY": (lambda i: uyvy(np.rint(i).astype(np.uint8)), "UYVY"),
    "Y10": (lambda i: np.rint(4 * i).astype(np.uint16), "Y10 "),
    "Y12": (lambda i: np.rint(16 * i).astype(np.uint16), "Y12 "),
    "Y16": (lambda i: np.rint(256 * i).astype(np.uint16), "Y16 "),
    **{name: (lambda i: np.rint(i).astype(np.uint8), name) for name in BAYER},
}


@pytest.mark.parametrize("name", FORMATS)
def test_a_roundel_is_detected_at_its_place_in_every_format(name: str):
    """Without noise, the error is below 0.02 px from rounding, and twice that after demosaicing."""
    disc = Card((80.3, 59.8), 30, 0.5, 0.7)
    scene = render([disc], bright=230.0)
    scene[:2] = 255  # so that the brightest pixel determines the depth of 10 to 16 bits
    encode, fourcc = FORMATS[name]
    (found,) = Detector().detect(to_grey(encode(scene), fourcc))
    centre = outline_of(disc)[0]
    assert np.abs(found.uv - centre).max() < (0.04 if fourcc in BAYER else 0.02)


def test_the_detector_refuses_images_that_are_not_converted():
    deep = (16 * render([Card((80.3, 59.8), 30, 0.5, 0.7)])).astype(np.uint16)
    with pytest.raises(ValueError, match="uint16"):
        Detector().detect(deep)  # pyright: ignore[reportArgumentType] the wrong type on purpose


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_folders_may_hold_images_of_more_than_eight_bits(tmp_path: Path, bits: int):
    deep = np.linspace(0, 2**bits - 1, 64).astype(np.uint16).reshape(8, 8)
    cv2.imwrite(str(tmp_path / "17.png"), deep)
    (frame,) = FrameFolder(tmp_path)
    assert np.array_equal(frame.image, narrow(deep))
