# SPDX-License-Identifier: BSD-3-Clause
"""A flat board of known size, as `charuco:5x4:0.054` names it on the command line."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.errors import ConfigError

Array = NDArray[np.float64]
FORM = "charuco:COLSxROWS:SQUARE_M[:MARKER_RATIO[:DICTIONARY]], such as charuco:5x4:0.054:0.75:DICT_4X4_50"


def make_board(text: str) -> Any:
    """The cv2.aruco.CharucoBoard that `text` names; marker ratio 0.75 and DICT_4X4_1000 unless given.

    Raises:
        ConfigError: the text has another form, an unknown dictionary or impossible sizes.
    """
    kind, *parts = text.split(":")
    try:
        if kind != "charuco" or not 2 <= len(parts) <= 4:
            raise ValueError
        columns, rows = (int(n) for n in parts[0].lower().split("x"))
        square = float(parts[1])
        ratio = float(parts[2]) if len(parts) > 2 and parts[2] else 0.75
        if not (columns >= 3 and rows >= 3 and 0.001 < square < 10 and 0.1 < ratio < 1):
            raise ValueError
    except ValueError:
        raise ConfigError(f"--board {text} is no board; write {FORM}") from None
    name = parts[3] if len(parts) > 3 else "DICT_4X4_1000"
    if not name.startswith("DICT_") or not hasattr(cv2.aruco, name):
        raise ConfigError(f"--board {text}: OpenCV has no dictionary {name}; write {FORM}")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    return cv2.aruco.CharucoBoard((columns, rows), square, ratio * square, dictionary)


class BoardFinder:
    """Finds a board's inner corners in grey images, printed normally or inverted."""

    def __init__(self, board: Any) -> None:
        self.corners = np.asarray(board.getChessboardCorners(), np.float32)
        parameters = cv2.aruco.DetectorParameters()
        parameters.detectInvertedMarker = True
        self._detector = cv2.aruco.CharucoDetector(board, cv2.aruco.CharucoParameters(), parameters)

    def find(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """Pixels (n, 2) and board points (n, 3), metres, of six or more corners; None where fewer are in sight."""
        for picture in (image, cv2.bitwise_not(image)):
            pixels, numbers = self._detector.detectBoard(picture)[:2]
            if numbers is not None and len(numbers) >= 6:
                return np.asarray(pixels, np.float32).reshape(-1, 2), self.corners[
                    np.ravel(numbers).astype(np.intp)
                ]
        return None
