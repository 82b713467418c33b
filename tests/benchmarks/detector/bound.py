# SPDX-License-Identifier: BSD-3-Clause
"""The Cramer-Rao bound of a roundel's centre and distance: the least variance of an unbiased estimator.

The unknowns are the five of the pose, the dark, bright and ground levels, and the blur. Derivatives are central
differences of ray-traced images. An unknown lens adds two unknowns: the position of the optical axis, which displaces
the image of the inner circle in that of the outer one.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.geometry.lens import Lens
from tests.camera_node.tracing import Sight, ellipse_of, trace

AXIS_PX = 20.0  # step of the optical axis: the inner circle moves by much less than a pixel
ROUNDING = 1 / 12  # variance of rounding to 8 bits, square grey levels


@dataclass(frozen=True)
class Bound:
    """For noise of one grey level: covariance (2, 2) of the ellipse's centre, and the distance's relative variance.

    `without_lens` is the covariance of the centre for an unknown lens.
    """

    centre: Array
    without_lens: Array
    distance: float

    def centre_variance(self, noise: float, knows_lens: bool = True) -> float:
        """Mean variance of the two coordinates including the rounding to grey levels, square pixels."""
        cov = self.centre if knows_lens else self.without_lens
        return float(np.trace(cov)) / 2 * (noise**2 + ROUNDING)

    def distance_variance(self, noise: float) -> float:
        """Variance of the relative error of the distance."""
        return self.distance * (noise**2 + ROUNDING)


@dataclass(frozen=True)
class PoseBound:
    """The least standard deviations where the lens and the print are known, each as the RMS of one coordinate.

    Attributes:
        centre: of the outer ellipse, pixels.
        size: of the mean of its diameters, relative.
        normal: radians.
    """

    centre: float
    size: float
    normal: float


PRINT_SIGMA = 0.002  # of the ratio of a print, which the detector assumes


def pose_bound(sight: Sight, pieces: int, noise: float) -> PoseBound:
    """The bound for known intrinsics without distortion and a print whose ratio is known to `PRINT_SIGMA`."""
    moves = [*list(_moves(sight))[:-2], lambda k: replace(sight, ratio=sight.ratio + 0.002 * k)]
    variance = noise**2 + ROUNDING
    J = np.array([(trace(move(1.0), pieces) - trace(move(-1.0), pieces)).ravel() / 2 for move in moves])
    information = J @ J.T / variance
    information[-1, -1] += (0.002 / PRINT_SIGMA) ** 2
    cov = np.linalg.inv(information)
    ahead, behind = ([ellipse_of(move(k)) for move in moves] for k in (1.0, -1.0))
    c = np.array([(a[0] - b[0]) / 2 for a, b in zip(ahead, behind, strict=True)])
    d = np.array([(a[1].sum() - b[1].sum()) / 2 for a, b in zip(ahead, behind, strict=True)])
    angle = 0.3 / _width(sight)
    return PoseBound(
        float(np.sqrt(np.trace(c.T @ cov @ c) / 2)),
        float(np.sqrt(d @ cov @ d) / ellipse_of(sight)[1].sum()),
        float(np.sqrt(np.trace(cov[3:5, 3:5]) / 2) * angle),
    )


def bound(sight: Sight, pieces: int) -> Bound:
    """The bound for a roundel and a lens without distortion."""
    grey, centre = [], []
    for move in _moves(sight):
        ahead, behind = move(1.0), move(-1.0)
        grey.append((trace(ahead, pieces) - trace(behind, pieces)).ravel() / 2)
        centre.append((ellipse_of(ahead)[0] - ellipse_of(behind)[0]) / 2)
    J, c = np.array(grey), np.array(centre)
    information = J @ J.T  # in steps
    known = np.s_[:-2, :-2]
    cov, blind = np.linalg.inv(information[known]), np.linalg.inv(information)
    distance = float(cov[2, 2]) * _distance_step(sight) ** 2
    return Bound(c[:-2].T @ cov @ c[:-2], c.T @ blind @ c, distance)


def _distance_step(sight: Sight) -> float:
    """The relative change of the distance that moves the edge by 0.05 px."""
    return 0.1 / _width(sight)


def _width(sight: Sight) -> float:
    return sight.lens.fx * sight.diameter_m / sight.distance_m


def _moves(sight: Sight) -> Iterator[Callable[[float], Sight]]:
    """For each unknown, the scene as a function of a number of steps; a step is small against nonlinear effects."""
    n, angle, (u, v) = sight.normal, 0.3 / _width(sight), sight.uv
    first = np.cross(n, [1.0, 0.0, 0.0])
    second = np.cross(n, first)
    yield lambda k: replace(sight, uv=(u + 0.05 * k, v))
    yield lambda k: replace(sight, uv=(u, v + 0.05 * k))
    yield lambda k: replace(sight, distance_m=sight.distance_m * (1 + k * _distance_step(sight)))
    yield lambda k: sight.with_normal(n + k * angle * first)
    yield lambda k: sight.with_normal(n + k * angle * second)
    for level in ("dark", "bright", "ground"):
        yield lambda k, level=level: replace(sight, **{level: getattr(sight, level) + k})
    yield lambda k: replace(sight, blur=sight.blur + 0.02 * k)
    for axis in ("cx", "cy"):
        yield lambda k, axis=axis: replace(sight, lens=_shifted(sight.lens, axis, AXIS_PX * k))


def _shifted(lens: Lens, axis: str, by: float) -> Lens:
    return msgspec.structs.replace(lens, **{axis: getattr(lens, axis) + by})
