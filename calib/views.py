# SPDX-License-Identifier: BSD-3-Clause
"""What one frame says of the wand: which roundel is which marker, and from known sizes or lengths where they are."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera_node.lens import Lens
from camera_node.roundels import Roundels

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The wand's markers in one frame.

    Attributes:
        camera: the camera's name.
        t_ns: middle of the exposure.
        labels: (n,) which marker of the wand each row is.
        roundels: their n detections, raw pixels.
        xy: (n, 2) undistorted image plane coordinates.
        points: (n, 3) where this view alone puts them, camera frame, metres; None where it can't.
    """

    camera: str
    t_ns: int
    labels: NDArray[np.intp]
    roundels: Roundels
    xy: Array
    points: Array | None

    def rows_of(self, labels: NDArray[np.intp]) -> NDArray[np.intp]:
        """The rows of these labels, all of which are there, in their order."""
        return np.array([int(np.flatnonzero(self.labels == label)[0]) for label in labels], np.intp)


def ranges(lens: Lens, roundels: Roundels, diameter_m: float) -> Array:
    """Distances (N,) of discs, metres, from the angle under which their major axis appears.

    A disc of diameter d at distance r, seen at any tilt, appears under the angle 2 atan(d / 2r) along its major axis.
    NaN where the detection has no axes.
    """
    along = np.column_stack([np.cos(roundels.angle_rad), np.sin(roundels.angle_rad)])
    half = roundels.axes_px[:, :1] / 2 * along
    known = np.isfinite(half).all(axis=1)
    distances = np.full(len(roundels), np.nan)
    if known.any():
        a, b = lens.rays((roundels.uv - half)[known]), lens.rays((roundels.uv + half)[known])
        distances[known] = diameter_m / np.linalg.norm(a - b, axis=1) * np.linalg.norm(a + b, axis=1) / 2
    return distances


def place_on_line(rays: Array, along: Array) -> tuple[Array, Array]:
    """Where three points of a straight line stand, from one view and their places on the line.

    The middle point divides the outer two in a known ratio, so s02 l1 r1 = s12 l0 r0 + s01 l2 r2 for the distances l
    along the rays r: the null vector of three columns gives l up to scale, and the line's length fixes that.

    Args:
        rays: (H, 3, 3) viewing rays, one row a point, of H triples.
        along: (3,) places of the points on the line, metres, ascending.

    Returns:
        anchors: (H, 3) the point at place 0, camera frame, metres.
        directions: (H, 3) unit directions of the line. NaN in both where a distance would be negative.
    """
    t0, t1, t2 = along
    columns = np.stack([(t2 - t1) * rays[:, 0], (t0 - t2) * rays[:, 1], (t1 - t0) * rays[:, 2]], axis=-1)
    distances = np.linalg.svd(columns)[2][:, -1]
    distances = distances * np.sign(distances.sum(axis=1, keepdims=True))
    first, last = distances[:, :1] * rays[:, 0], distances[:, 2:] * rays[:, 2]
    length = np.linalg.norm(last - first, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        direction = (last - first) / length
        anchor = first / length * (t2 - t0) - t0 * direction
    bad = ~((distances > 0).all(axis=1) & (length[:, 0] > 1e-12))
    anchor[bad], direction[bad] = np.nan, np.nan
    return anchor, direction
