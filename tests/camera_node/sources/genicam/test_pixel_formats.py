# SPDX-License-Identifier: BSD-3-Clause
"""Every pixel format of GenICam cameras becomes the same 8-bit grey."""

import numpy as np
import pytest
from numpy.typing import NDArray

from camera_node.sources.genicam.pixel_formats import parse_pixel_format
from camera_node.sources.grey import to_grey

SHAPE = (6, 7)  # an odd number of pixels in a row: packed groups cross rows


def pack_bits(levels: NDArray, bits: int) -> NDArray[np.uint8]:
    """PFNC's `p`: one stream of bits, each pixel from its least significant one."""
    stream = levels.reshape(-1, 1) >> np.arange(bits) & 1
    return np.packbits(stream.astype(np.uint8).ravel(), bitorder="little")


def pack_gige(levels: NDArray, bits: int) -> NDArray[np.uint8]:
    """GigE Vision's `Packed`: three bytes hold the upper 8 bits of two pixels with the lower ones between them."""
    pairs = np.pad(levels.ravel(), (0, levels.size % 2)).reshape(-1, 2)
    shift, mask = bits - 8, 2 ** (bits - 8) - 1
    lower = (pairs[:, 0] & mask) | (pairs[:, 1] & mask) << 4
    return np.stack([pairs[:, 0] >> shift, lower, pairs[:, 1] >> shift], 1).astype(np.uint8).ravel()


def words(levels: NDArray, bits: int) -> NDArray[np.uint8]:
    return levels.astype("<u2").view(np.uint8).ravel()


@pytest.mark.parametrize(
    ("name", "bits", "pack"),
    [
        ("Mono8", 8, lambda levels, bits: levels.astype(np.uint8).ravel()),
        ("Mono10", 10, words),
        ("Mono12", 12, words),
        ("Mono14", 14, words),
        ("Mono16", 16, words),
        ("Mono10p", 10, pack_bits),
        ("Mono12p", 12, pack_bits),
        ("Mono10Packed", 10, pack_gige),
        ("Mono12Packed", 12, pack_gige),
    ],
)
def test_each_format_is_unpacked_and_rounded(name: str, bits: int, pack):
    """Full scale becomes 255 whatever the brightest pixel is, and levels in between are right to half a level."""
    full = 2**bits - 1
    levels = np.random.default_rng(5).integers(
        0, full // 3, SHAPE
    )  # a dark image of more bits is no bright one
    levels[0, 0], levels[-1, -1] = 0, full // 3
    pixel_format = parse_pixel_format(name)
    assert pixel_format is not None
    image = pixel_format.to_grey(pack(levels, bits), SHAPE[1], SHAPE[0])
    assert image.shape == SHAPE
    assert np.abs(image - levels * (255 / full)).max() <= 0.5 + 1e-6
    with pytest.raises(ValueError, match="bytes for 7 x 6 pixels"):
        pixel_format.to_grey(pack(levels, bits)[:-3], SHAPE[1], SHAPE[0])


@pytest.mark.parametrize(
    ("name", "fourcc"), [("BayerRG", "RGGB"), ("BayerGR", "GRBG"), ("BayerGB", "GBRG"), ("BayerBG", "BA81")]
)
def test_mosaics_are_those_of_v4l2(name: str, fourcc: str):
    mosaic = np.random.default_rng(6).integers(0, 256, (8, 10), dtype=np.uint8)
    deep = mosaic.astype(np.uint16) * 257 >> 4  # 12 bits of the same levels
    for text, data in ((f"{name}8", mosaic.ravel()), (f"{name}12p", pack_bits(deep, 12))):
        pixel_format = parse_pixel_format(text)
        assert pixel_format is not None
        assert np.abs(pixel_format.to_grey(data, 10, 8).astype(int) - to_grey(mosaic, fourcc)).max() <= 1


def test_an_image_outlives_the_buffer_of_the_camera():
    data = np.full(42, 7, np.uint8)
    pixel_format = parse_pixel_format("Mono8")
    assert pixel_format is not None
    assert not np.shares_memory(pixel_format.to_grey(data, 7, 6), data)


def test_other_formats_are_not_read():
    assert [parse_pixel_format(name) for name in ("RGB8", "YUV422_8", "Mono8p", "Coord3D_C16", "")] == [
        None
    ] * 5
