# SPDX-License-Identifier: BSD-3-Clause
"""What cameras and files give, as the 8-bit grey that the detector works on; copied only where it must be.

Why 8 bits are enough of 10 to 16: rounding to 8 adds noise of 1 / sqrt(12) = 0.29 levels. A sensor's own is 1 level or
more wherever a roundel can be read: a full well of 10,000 electrons that fills 255 levels has shot noise of 1 level at
the dark end of the print (level 10) and 1.8 in the middle. In squares, 0.29 on 1 widens every error by 4 % at most.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.arrays import Grey

DEPTHS = (8, 10, 12, 14, 16)  # bits that sensors have

# V4L2's names of raw formats. Mosaics go by the colours of their first row; OpenCV names them by the second's.
LUMA = {"YUYV": 0, "UYVY": 1}  # the channel that holds the grey level
BAYER = {
    "RGGB": cv2.COLOR_BayerBG2GRAY,
    "GRBG": cv2.COLOR_BayerGB2GRAY,
    "GBRG": cv2.COLOR_BayerGR2GRAY,
    "BA81": cv2.COLOR_BayerRG2GRAY,  # SBGGR8
}
RAW = (*LUMA, *BAYER, "GREY", "Y10 ", "Y12 ", "Y16 ")


def grey(image: NDArray, fourcc: str | None = None) -> Grey:
    """The grey levels (h, w), uint8, of an image of any of these kinds; an 8-bit grey image comes back as it is.

    Args:
        image: (h, w) grey or a mosaic, (h, w, 2) YUV, (h, w, 3) BGR; 8 bits, or grey of 10 to 16 bits in 16.
        fourcc: the format of what V4L2 delivered, where the shape does not tell: one of `RAW`. A mosaic is
            interpolated, which joins the noise of neighbours: covariances are then a little too small.
    """
    if image.ndim == 3 and image.shape[2] == 2:
        return cv2.extractChannel(image, LUMA.get(fourcc or "", 0)).astype(np.uint8, copy=False)
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    elif fourcc in BAYER:
        image = cv2.cvtColor(image, BAYER[fourcc])
    if image.dtype == np.uint16:
        return narrow(image)
    return image if image.strides[1] == image.itemsize == 1 else np.ascontiguousarray(image, np.uint8)


def narrow(image: NDArray[np.uint16]) -> Grey:
    """Grey of 10 to 16 bits (h, w) as 8 bits, rounded: the full scale becomes 255.

    The scale is the least of 8, 10, 12, 14 and 16 bits that holds the brightest pixel: containers don't tell it.
    """
    if not image.size:
        return np.empty(image.shape, np.uint8)
    brightest = int(image.max())
    full = next(2**bits - 1 for bits in DEPTHS if brightest < 2**bits)
    return cv2.convertScaleAbs(image, alpha=255 / full).astype(np.uint8, copy=False)
