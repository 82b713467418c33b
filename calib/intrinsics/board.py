# SPDX-License-Identifier: BSD-3-Clause
"""Finds calibration boards, which the command line names `charuco:5x4:0.054` or `chessboard:9x6:0.025`."""

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.foundation.arrays import Grey
from camera_node.foundation.errors import ConfigError
from camera_node.printing.sheets import MARKER_RATIO

Corners = tuple[NDArray[np.float32], NDArray[np.float32]]

MIN_CORNERS = 6  # of a board that is partly visible
CHARUCO_PARTS, CHESSBOARD_PARTS = 4, 2  # of the text after the kind of board, at most
WINDOW, MIN_WINDOW_PX = (
    0.35,
    2,
)  # half of the window of a corner's refinement, of the distance to the next corner
REFINED = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-4)
DICTIONARY = "DICT_4X4_1000"  # unless given
FORM = (
    "charuco:COLSxROWS:SQUARE_M[:MARKER_RATIO[:DICTIONARY]] in squares, such as charuco:5x4:0.054:0.75:DICT_4X4_50, "
    "or chessboard:COLSxROWS:SQUARE_M in inner corners, such as chessboard:9x6:0.025"
)


class BoardFinder(Protocol):
    """Finds the corners of one board in images."""

    def find(self, image: Grey) -> Corners | None:
        """Pixels (n, 2) and board points (n, 3), metres, in an image (h, w); None if there are too few."""
        ...


def make_finder(text: str) -> BoardFinder:
    """The finder of the board that `text` names.

    Raises:
        ConfigError: the text has another form, an unknown dictionary or impossible sizes.
    """
    if text.split(":")[0] == "chessboard":
        return ChessboardFinder(*_parse_size(text, text.split(":")[1:], CHESSBOARD_PARTS))
    return CharucoFinder(make_charuco_board(text))


def make_charuco_board(text: str) -> Any:
    """The cv2.aruco.CharucoBoard that `text` names; marker ratio 0.75 and DICT_4X4_1000 unless given.

    Raises:
        ConfigError: the text has another form, an unknown dictionary or impossible sizes.
    """
    kind, *parts = text.split(":")
    if kind != "charuco":
        raise ConfigError(f"--board {text} is not a board; write {FORM}")
    columns, rows, square = _parse_size(text, parts, CHARUCO_PARTS)
    try:
        ratio = float(parts[2]) if len(parts) > 2 and parts[2] else MARKER_RATIO
    except ValueError:
        ratio = 0.0
    if not 0.1 < ratio < 1:
        raise ConfigError(f"--board {text} is not a board; write {FORM}")
    name = parts[3] if len(parts) > 3 else DICTIONARY
    if not name.startswith("DICT_") or not hasattr(cv2.aruco, name):
        raise ConfigError(f"--board {text}: OpenCV has no dictionary {name}; write {FORM}")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    return cv2.aruco.CharucoBoard((columns, rows), square, ratio * square, dictionary)


def _parse_size(text: str, parts: list[str], max_parts: int) -> tuple[int, int, float]:
    """Columns, rows and the side of a square, metres, which come first for both kinds of board."""
    try:
        if not 2 <= len(parts) <= max_parts:
            raise ValueError
        columns, rows = (int(n) for n in parts[0].lower().split("x"))
        square = float(parts[1])
        if not (3 <= columns <= 100 and 3 <= rows <= 100 and 0.001 < square < 10):
            raise ValueError
    except ValueError:
        raise ConfigError(f"--board {text} is not a board; write {FORM}") from None
    return columns, rows, square


class CharucoFinder:
    """Finds the inner corners of a ChArUco board, printed normally or inverted."""

    def __init__(self, board: Any) -> None:
        self.corners = np.asarray(board.getChessboardCorners(), np.float32)
        parameters = cv2.aruco.DetectorParameters()
        parameters.detectInvertedMarker = True
        self._detector = cv2.aruco.CharucoDetector(board, cv2.aruco.CharucoParameters(), parameters)

    def find(self, image: Grey) -> Corners | None:
        """Pixels (n, 2) and board points (n, 3), metres, of six or more corners; None if fewer are visible."""
        for candidate in (image, cv2.bitwise_not(image)):
            pixels, numbers = self._detector.detectBoard(candidate)[:2]
            if numbers is not None and len(numbers) >= MIN_CORNERS:
                points = self.corners[np.ravel(numbers).astype(np.intp)]
                return np.asarray(pixels, np.float32).reshape(-1, 2), points
        return None


@dataclass(frozen=True)
class ChessboardFinder:
    """Finds a plain chessboard, of which all `columns` x `rows` inner corners must be visible."""

    columns: int
    rows: int
    square_m: float

    @property
    def corners(self) -> NDArray[np.float32]:
        """(columns * rows, 3) inner corners, metres, row by row."""
        y, x = np.mgrid[0 : self.rows, 0 : self.columns].astype(np.float32) * self.square_m
        return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]).astype(np.float32)

    def find(self, image: Grey) -> Corners | None:
        """Pixels (n, 2) and board points (n, 3), metres, of all corners; None unless all are visible.

        The finder by sectors (Duda and Frese 2018) fails under uneven light and without a white border, where the one
        by quadrangles finds the board; its corners are refined to the same noise or less.
        """
        size, flags = (self.columns, self.rows), cv2.CALIB_CB_NORMALIZE_IMAGE
        found, pixels = cv2.findChessboardCornersSB(image, size, flags=flags | cv2.CALIB_CB_ACCURACY)
        if not found:
            flags |= cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_FAST_CHECK
            found, pixels = cv2.findChessboardCorners(image, size, flags=flags)
            if not found:
                return None
            pixels = self._refine(image, np.asarray(pixels, np.float32).reshape(-1, 2))
        return np.asarray(pixels, np.float32).reshape(-1, 2), self.corners

    def _refine(self, image: Grey, pixels: NDArray[np.float32]) -> Any:
        """Refine corners (n, 2) by the gradients around them, in windows that no other corner is in."""
        rows = pixels.reshape(self.rows, self.columns, 2)
        gaps = [np.linalg.norm(np.diff(rows, axis=axis), axis=2).min() for axis in (0, 1)]
        half = max(MIN_WINDOW_PX, int(WINDOW * min(gaps)))
        return cv2.cornerSubPix(image, pixels.reshape(-1, 1, 2), (half, half), (-1, -1), REFINED)
