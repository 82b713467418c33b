# SPDX-License-Identifier: BSD-3-Clause
"""Markers of equal printed area with their detectors: our roundel, the paper's method, AprilTag 3 and ArUco."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from camera_node.detection.detector import Detector
from camera_node.detection.disc_pose import locate as locate_disc
from camera_node.foundation.arrays import Array, Grey
from camera_node.geometry.lens import Lens
from tests.benchmarks.paper.published import PATTERN
from tests.benchmarks.paper.reference import PaperDetector, locate
from tests.benchmarks.paper.scenes import BRIGHT, DARK, Print, roundel, square_tag

AREA_M2 = np.pi / 4 * PATTERN.d**2  # of the whole card, with its margin
NUMBER = 7  # of the tags
APRILTAG_PIXEL = 0.5  # AprilTag counts from the corner of the first pixel


@dataclass(frozen=True, eq=False)
class Found:
    """A marker that was found: position (3,) in metres, and normals (K, 3), the likeliest first; all are in question
    if `ambiguous`."""

    position_m: Array
    normals: Array
    ambiguous: bool = False


Finder = Callable[[list[Grey], Lens], list[Found]]


@dataclass(frozen=True)
class Marker:
    """A print and what finds it in the last of a few images of one view."""

    name: str
    sheet: Print
    find: Finder


def markers() -> list[Marker]:
    """All markers with an installed detector; AprilTag 3 needs pyapriltags."""
    own = roundel(PATTERN)
    found = [Marker("roundel, ours", own, find_roundels), Marker("roundel, reference", own, find_segments)]
    april, side = _square("DICT_APRILTAG_36h11", 8)
    if finder := _april_finder(side):
        found.append(Marker("AprilTag 3, 36h11", april, finder))
    aruco, side = _square("DICT_4X4_50", 6)
    return [*found, Marker("ArUco 4x4", aruco, _aruco_finder(side))]


def _square(dictionary: str, cells: int) -> tuple[Print, float]:
    """A tag with a margin of one cell, and the side of its black border in metres."""
    tags = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    image = cv2.aruco.generateImageMarker(tags, NUMBER, cells)
    side = float(np.sqrt(AREA_M2)) * cells / (cells + 2)
    return square_tag(np.asarray(image) / 255, side), side


def find_roundels(images: list[Grey], lens: Lens) -> list[Found]:
    """Ours; the detector learns the camera's response from the first images."""
    detector = Detector(inner_ratios=(PATTERN.d_i / PATTERN.d_o,), min_diameter_px=6)
    for image in images[:-1]:
        detector.detect(image)
    poses = [locate_disc(found, lens, PATTERN.d_o) for found in detector.detect(images[-1])]
    return [
        Found(first.position_m, np.array([first.normal, second.normal]))
        for first, second in (pair for pair in poses if pair)
    ]


def find_segments(images: list[Grey], lens: Lens) -> list[Found]:
    """The paper's method, from the best threshold on. It does not tell the two normals apart."""
    detector = PaperDetector((DARK + BRIGHT) / 2)
    for image in images[:-1]:
        detector.detect(image)
    poses = [locate(segment, lens, PATTERN.d_o) for segment in detector.detect(images[-1])]
    return [Found(pose.position_m, pose.normals, True) for pose in poses]


def _april_finder(side: float) -> Finder | None:
    try:
        make = importlib.import_module("pyapriltags").Detector
    except ImportError:
        return None
    detector = make(families="tag36h11", nthreads=1, quad_decimate=1.0)

    def find(images: list[Grey], lens: Lens) -> list[Found]:
        tags = [tag for tag in detector.detect(images[-1]) if tag.tag_id == NUMBER]
        return [_locate_square(tag.corners[::-1] - APRILTAG_PIXEL, lens, side) for tag in tags]

    return find


def _aruco_finder(side: float) -> Finder:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    detector = cv2.aruco.ArucoDetector(tags, parameters)

    def find(images: list[Grey], lens: Lens) -> list[Found]:
        corners, numbers, _ = detector.detectMarkers(images[-1])
        known = [] if numbers is None else np.ravel(numbers).tolist()
        return [
            _locate_square(np.asarray(c, float)[0], lens, side)
            for c, number in zip(corners, known, strict=True)
            if number == NUMBER
        ]

    return find


def _locate_square(corners: Array, lens: Lens, side: float) -> Found:
    """The pose of a square by OpenCV's IPPE_SQUARE; corners (4, 2) clockwise in the image."""
    square = side / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], float)
    lens_of = (lens.K, np.array(lens.distortion or (0.0,) * 4))
    _, turns, positions, _ = cv2.solvePnPGeneric(square, corners, *lens_of, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in turns], float)
    return Found(np.asarray(positions[0], float).ravel(), normals)
