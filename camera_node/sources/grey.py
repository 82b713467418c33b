# SPDX-License-Identifier: BSD-3-Clause
"""Converts images of cameras and files to 8-bit grey, without a copy where the image is already 8-bit grey.

8 of 10 to 16 bits are enough. Rounding to 8 bits adds noise of 1 / sqrt(12) = 0.29 grey levels. The sensor's own noise
is at least 1 level wherever a roundel can be detected: with a full well of 10,000 electrons at 255 levels, the shot
noise is 1 level at the dark end of the print (level 10) and 1.8 in the middle. The sum of squares shows that rounding
enlarges every error by at most 4 %.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.foundation.arrays import Grey

DEPTHS = (8, 10, 12, 14, 16)  # bits per pixel of image sensors

# V4L2's names of raw formats. V4L2 names mosaics by the colours of their first row, OpenCV by those of the second.
LUMA = {"YUYV": 0, "UYVY": 1}  # the channel that holds the grey level
BAYER = {
    "RGGB": cv2.COLOR_BayerBG2GRAY,
    "GRBG": cv2.COLOR_BayerGB2GRAY,
    "GBRG": cv2.COLOR_BayerGR2GRAY,
    "BA81": cv2.COLOR_BayerRG2GRAY,  # SBGGR8
}
DEPTH = {"Y10 ": 10, "Y12 ": 12}  # bits; Y16 states none, because sensors of fewer bits deliver it, too
RAW = (*LUMA, *BAYER, *DEPTH, "GREY", "Y16 ")


def to_grey(image: NDArray, fourcc: str | None = None) -> Grey:
    """Convert an image to grey levels (h, w), uint8; an 8-bit grey image is returned as it is.

    Args:
        image: (h, w) grey or Bayer mosaic, (h, w, 2) YUV, (h, w, 3) BGR; 8 bits, or grey of 10 to 16 bits in uint16.
        fourcc: one of `RAW` for an image from V4L2 whose shape does not determine its format. Demosaicing correlates
            the noise of neighbouring pixels, so that the detector's covariances are slightly too small.
    """
    if image.ndim == 3 and image.shape[2] == 2:
        return cv2.extractChannel(image, LUMA.get(fourcc or "", 0)).astype(np.uint8, copy=False)
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    elif fourcc in BAYER:
        image = cv2.cvtColor(image, BAYER[fourcc])
    if image.dtype == np.uint16:
        return narrow(image, DEPTH.get(fourcc or ""))
    return image if image.strides[1] == image.itemsize == 1 else np.ascontiguousarray(image, np.uint8)


def narrow(image: NDArray[np.uint16], bits: int | None = None) -> Grey:
    """Scale grey of 10 to 16 bits (h, w) to 8 bits, rounded; full scale becomes 255.

    Args:
        image: grey levels.
        bits: of full scale. None: the smallest of 8, 10, 12, 14 and 16 that holds the brightest pixel, because uint16
            arrays and image files do not state their depth.
    """
    if not image.size:
        return np.empty(image.shape, np.uint8)
    brightest = int(image.max())
    bits = bits or next(depth for depth in DEPTHS if brightest < 2**depth)
    return cv2.convertScaleAbs(image, alpha=255 / (2**bits - 1)).astype(np.uint8, copy=False)
