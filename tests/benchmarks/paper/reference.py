# SPDX-License-Identifier: BSD-3-Clause
"""The paper's detector and localization, written plainly from its Section III, as a reference for comparisons only.

It differs from `Detector(detector="paper")`, which uses local thresholds and our fit: here one threshold theta is that
of the whole image, and the pose comes from the moments of the segments. Region growing is OpenCV's labelling.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from camera_node.detection.disc_pose import decompose
from camera_node.foundation.arrays import Array, Grey, Index, Mask
from camera_node.geometry.lens import Lens

THETA = 128.0
BOX_TOLERANCE = 0.3  # of the area against that of the bounding box
AREA_TOLERANCE = 0.3  # of the ratio of areas
INNER_RATIO = 0.6


@dataclass(frozen=True, eq=False)
class Segment:
    """A pair of segments that passed all tests: centre (2,) and covariance (2, 2) of its pixels, and mean levels."""

    uv: Array
    cov: Array
    dark: float
    bright: float


@dataclass(frozen=True, eq=False)
class PaperPose:
    """Position (3,) in metres, and both normals (2, 3) of the ellipse, in no order."""

    position_m: Array
    normals: Array


class PaperDetector:
    """Section III-B: searches whole frames; the threshold theta follows the pattern, or steps while there is none.

    Args:
        theta: the first threshold, grey levels.
    """

    def __init__(self, theta: float = THETA) -> None:
        self.theta = theta
        self._steps = 1

    def detect(self, image: Grey) -> list[Segment]:
        """All patterns of an image, uint8 (h, w)."""
        found = find_segments(image, self.theta)
        if found:
            self.theta = float(np.mean([(s.dark + s.bright) / 2 for s in found]))
            self._steps = 1
        else:
            self._step()
        return found

    def _step(self) -> None:
        """1/2, 1/4, 3/4, 1/8, ... of the grey scale."""
        self._steps = self._steps % 31 + 1
        digits = f"{self._steps:b}"[::-1]
        self.theta = 256 * sum(int(digit) / 2 ** (k + 1) for k, digit in enumerate(digits))


def find_segments(image: Grey, theta: float) -> list[Segment]:
    """Dark segments with a bright one in their middle that are round, concentric and of the right ratio of areas."""
    dark = (image < theta).astype(np.uint8)
    labels, stats, centres = _label(dark, 4)
    holes, hole_stats, hole_centres = _label(1 - dark, 8)
    h, w = image.shape
    found = []
    for k in np.flatnonzero(_may_be_rings(stats, w, h)):
        u, v = np.rint(centres[k]).astype(int)
        hole = holes[v, u]
        if hole == 0 or not _match(stats[k], hole_stats[hole], centres[k] - hole_centres[hole]):
            continue
        found.append(_measure(image, labels == k, holes == hole, stats[k]))
    return found


def _label(dark: Grey, connectivity: int) -> tuple[Index, Index, Array]:
    """Labels (h, w), boxes and areas (N, 5), and centres (N, 2) of the connected pixels that are 1."""
    _, labels, stats, centres = cv2.connectedComponentsWithStats(dark, connectivity=connectivity)
    return np.asarray(labels, np.intp), np.asarray(stats, np.intp), np.asarray(centres, float)


def _may_be_rings(stats: Index, w: int, h: int) -> Mask:
    x, y, width, height, area = stats.T
    inside = (x > 0) & (y > 0) & (x + width < w) & (y + height < h)
    # A ring has 1 - ratio^2 of the disc's area, a slanted and turned one less of its box.
    ring = np.pi / 4 * (1 - INNER_RATIO**2) * width * height
    large = (width >= 6) & (height >= 4)
    large[0] = False  # label 0 is all bright pixels
    return inside & large & (area > (1 - BOX_TOLERANCE) * ring * 0.5) & (area < (1 + BOX_TOLERANCE) * ring)


def _match(ring: Index, hole: Index, apart: Array) -> bool:
    disc = ring[4] + hole[4]
    box = np.pi / 4 * ring[2] * ring[3]
    inside = (
        hole[0] > ring[0]
        and hole[1] > ring[1]
        and hole[0] + hole[2] < ring[0] + ring[2]
        and hole[1] + hole[3] < ring[1] + ring[3]
    )
    ratio = hole[4] / disc / INNER_RATIO**2
    concentric = np.linalg.norm(apart) < 0.1 * min(ring[2], ring[3]) + 0.5
    return bool(
        inside
        and concentric
        and abs(ratio - 1) < AREA_TOLERANCE + 4 / min(ring[2], ring[3])
        and (1 - 2 * BOX_TOLERANCE) * box < disc < (1 + BOX_TOLERANCE) * box
    )


def _measure(image: Grey, ring: Mask, hole: Mask, box: Index) -> Segment:
    """Centre, covariance matrix and levels of a disc's pixels."""
    x, y, width, height = box[:4]
    part = np.s_[y : y + height, x : x + width]
    v, u = np.nonzero(ring[part] | hole[part])
    points = np.stack([u + x, v + y]).astype(float)
    return Segment(
        points.mean(axis=1),
        np.asarray(np.cov(points), float),
        float(image[part][ring[part]].mean()),
        float(image[part][hole[part]].mean()),
    )


def locate(segment: Segment, lens: Lens, d_o: float) -> PaperPose:
    """Section III-C: the rays of the principal axis's end points, scaled so that their distance is d_o.

    A semi-axis has two standard deviations of the disc's pixels. It is found in an image of square pixels, since
    f_x and f_y of the paper's camera may differ.
    """
    pixels = np.diag([lens.fx, lens.fy])
    square = np.linalg.inv(pixels)
    values, vectors = np.linalg.eigh(square @ segment.cov @ square)
    other, half = (pixels @ (2 * np.sqrt(value) * v) for value, v in zip(values, vectors.T, strict=True))
    first, second = lens.rays(np.array([segment.uv + half, segment.uv - half]))
    scale = d_o / np.linalg.norm(first - second)
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)[:, None]
    edge = segment.uv + np.cos(around) * half + np.sin(around) * other
    return PaperPose(scale * (first + second) / 2, _normals(lens.normalise(edge), d_o / 2))


def _normals(xy: Array, radius: float) -> Array:
    """(2, 3) both normals of the disc whose outline (N, 2) is given in the normalised image plane."""
    x, y = xy.T
    a, b, c, d, e = np.linalg.lstsq(
        np.column_stack([x * x, x * y, y * y, x, y]), np.ones(len(x)), rcond=None
    )[0]
    Q = np.array([[a, b / 2, d / 2], [b / 2, c, e / 2], [d / 2, e / 2, -1.0]])
    if a + c < 0:
        Q = -Q
    return decompose(Q[None], radius)[1][0]
