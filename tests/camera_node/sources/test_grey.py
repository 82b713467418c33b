# SPDX-License-Identifier: BSD-3-Clause
"""Every format that cameras deliver becomes the same 8-bit grey."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from camera_node.detection.detector import Detector
from camera_node.sources.grey import BAYER, grey, narrow
from camera_node.sources.replay import FolderSource
from tests.camera_node.rendering import Disc, outer_conic, render

LEVELS = np.arange(24, dtype=np.uint8).reshape(4, 6) * 10
PRINCIPAL = np.array([79.5, 59.5])


def yuyv(image: NDArray) -> NDArray:
    return np.stack([image, np.full_like(image, 128)], axis=-1)


def uyvy(image: NDArray) -> NDArray:
    return yuyv(image)[..., ::-1].copy()


def test_grey_is_not_copied():
    assert np.shares_memory(grey(LEVELS), LEVELS)
    assert np.shares_memory(grey(LEVELS[::2, 1:4], "GREY"), LEVELS)


def test_yuv_is_grey_with_colour_beside_it():
    assert np.array_equal(grey(yuyv(LEVELS), "YUYV"), LEVELS)
    assert np.array_equal(grey(yuyv(LEVELS)), LEVELS)
    assert np.array_equal(grey(uyvy(LEVELS), "UYVY"), LEVELS)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_deep_grey_is_scaled_and_rounded(bits: int):
    """The full scale becomes 255, nothing 0, and all between is right to half a level."""
    full = 2**bits - 1
    deep = np.linspace(0, full, 60).astype(np.uint16).reshape(6, 10)
    narrowed = narrow(deep)
    assert narrowed.dtype == np.uint8
    assert (narrowed[0, 0], narrowed[-1, -1]) == (0, 255)
    assert np.abs(narrowed - deep * (255 / full)).max() <= 0.5 + 1e-6
    assert narrow(np.empty((0, 5), np.uint16)).shape == (0, 5)


@pytest.mark.parametrize("fourcc", BAYER)
def test_a_mosaic_knows_where_red_is(fourcc: str):
    """Of pure red, 200, a mosaic has one pixel in four; the luma is 0.299 of it, as in ITU-R BT.601."""
    at = {"RGGB": (0, 0), "GRBG": (0, 1), "GBRG": (1, 0), "BA81": (1, 1)}[fourcc]
    mosaic = np.zeros((8, 8), np.uint8)
    mosaic[at[0] :: 2, at[1] :: 2] = 200
    assert np.abs(grey(mosaic, fourcc)[2:-2, 2:-2] - 0.299 * 200).max() <= 1


def test_colour_becomes_luma():
    """0.114 B + 0.587 G + 0.299 R."""
    assert grey(np.full((2, 2, 3), (100, 50, 200), np.uint8)) == pytest.approx(np.full((2, 2), 101), abs=1)


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
def test_a_roundel_is_where_it_is_in_every_format(name: str):
    """Without noise, within the 0.02 px that rounding leaves; interpolating a mosaic may cost as much again."""
    disc = Disc((80.3, 59.8), 30, 0.5, 0.7)
    scene = render([disc], bright=230.0)
    scene[:2] = 255  # so that the scale of 10 to 16 bits shows
    encode, fourcc = FORMATS[name]
    (found,) = Detector().detect(grey(encode(scene), fourcc))
    centre = outer_conic(disc, PRINCIPAL)[0]
    assert np.abs(found.uv - centre).max() < (0.04 if fourcc in BAYER else 0.02)


def test_the_detector_takes_sixteen_bits_as_they_are():
    scene = render([Disc((80.3, 59.8), 30, 0.5, 0.7)])
    deep, shallow = (16 * scene).astype(np.uint16), Detector().detect(np.rint(scene).astype(np.uint8))
    found = Detector().detect(deep)
    assert found.uv == pytest.approx(shallow.uv, abs=0.01)


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_folders_of_deep_pictures(tmp_path: Path, bits: int):
    deep = np.linspace(0, 2**bits - 1, 64).astype(np.uint16).reshape(8, 8)
    cv2.imwrite(str(tmp_path / "17.png"), deep)
    (frame,) = FolderSource(tmp_path)
    assert np.array_equal(frame.image, narrow(deep))
