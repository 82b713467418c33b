# SPDX-License-Identifier: BSD-3-Clause
"""The shape and the size of the wand, from its file and from what the cameras measure.

Cameras measure the shape of the wand, not its size: that is the file's. Which of the file's distances are wrong follows
from the shape as far as their errors are few. The model: every marker's place in the file has an error of a common
standard deviation, and one marker may have a larger one; both deviations, and which marker, are unknown. Given these,
shape and size are jointly Gaussian. A wand of three markers does not show which of them is wrong, so that its size is
as uncertain as its shape is wrong; of four markers the wrong one is found, because the other three agree.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.optimize import root_scalar
from scipy.special import chdtrc, ndtr

from calib.errors import CalibrationError
from calib.rig.estimation import CHANCE
from calib.wand.bundle_adjustment.problem import Adjusted
from camera_node.foundation.arrays import Array, Index

MIN_ERROR = 0.002  # of the largest distance: an error of a distance that is worth a sentence
MAX_SIGMA = 0.05  # of the size, relative: a wand that is known worse must be measured again
EXACT_M = 1e-6  # the least standard deviation of a shape: recordings without noise have none
# Standard deviations of a marker's place, as shares of the largest distance, equally probable by their logarithms.
PLACES = np.geomspace(1e-5, 0.1, 13)


@dataclass(frozen=True, slots=True)
class WandShape:
    """Distances between the markers of a wand, and its size.

    Attributes:
        pairs: (P, 2) of markers.
        given, found: (P,) their distances by the wand's file, and as the cameras measure them, metres.
        chance: probability of shapes that differ as much by noise alone.
        size: of the wand, relative to its file, and its standard deviation.
    """

    pairs: Index
    given: Array
    found: Array
    chance: float
    size: tuple[float, float]

    @property
    def error(self) -> float:
        """The largest difference, as a share of the largest distance; 0 where noise explains it."""
        off = np.abs(self.found - self.given).max() / self.given.max()
        return float(off) if self.chance < CHANCE else 0.0

    def sentence(self) -> str:
        """The distance that is off by the largest share; empty if none matters."""
        if self.error < MIN_ERROR:
            return ""
        off = np.abs(np.log(self.found / self.given))
        worst, best = int(off.argmax()), int(off.argmin())
        (a, b), (c, d) = self.pairs[worst].tolist(), self.pairs[best].tolist()
        found = self.found[worst] * self.given[best] / self.found[best]
        return (
            f"the wand differs from its file: markers {a} and {b} are {self.given[worst]:.4f} m apart there, and "
            f"{found:.4f} m as the cameras measure it, if {c} and {d} are {self.given[best]:.4f} m apart"
        )


def measure_shape(adjusted: Adjusted) -> WandShape | None:
    """The adjusted shape of the wand; None where it has one shape only, or that of its file."""
    wand, shape = adjusted.problem.wand, adjusted.state.shape
    if not (n := len(adjusted.shape_covariance)):
        return None
    covariance = adjusted.scale**2 * adjusted.inflation * adjusted.shape_covariance + EXACT_M**2 * np.eye(n)
    pairs = np.array(list(combinations(range(len(wand.points)), 2)))
    given, found = (
        np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
        for points in (wand.points, wand.displaced(shape).points)
    )
    size, sigma = infer_size(wand.points, wand.shapes, shape, covariance)
    chance = float(chdtrc(n, shape @ np.linalg.solve(covariance, shape)))
    return WandShape(pairs, given, size * found, chance, (size, sigma))


def infer_size(points: Array, shapes: Array, shape: Array, covariance: Array) -> tuple[float, float]:
    """The size of the wand relative to its file, and its standard deviation: half of the 68 % around the median.

    Args:
        points, shapes: `AffineWand.points` and `AffineWand.shapes` of the file.
        shape, covariance: (n,) and (n, n) measured.
    """
    off = points - points.mean(axis=0)
    by_size = off / (off**2).sum()  # the size's change by each marker's place
    variances = (PLACES * np.linalg.norm(points[:, None] - points, axis=2).max()) ** 2  # (k,)
    e, V = np.linalg.eigh(covariance)
    y, N = V.T @ shape, V.T @ np.swapaxes(shapes, 0, 1)  # (n,) and (M, n, 3)
    # With the deviation of all places alone, k of them: what the shape shows of each marker's place.
    D = 1 / (e + variances[:, None])
    H = np.einsum("mni,kn,mnj->mkij", N, D, N, optimize=True)[:, :, None]
    b = np.einsum("mni,kn->mki", N, D * y)[:, :, None, :, None]
    # With the further deviation of one marker, on the third axis: Woodbury's identity.
    K, along = H + np.eye(3) / variances[:, None, None], by_size[:, None, None, :, None]
    of_shape, of_size = np.linalg.solve(K, b), np.linalg.solve(K, along)
    mean = (along * of_shape).sum(axis=(3, 4))
    variance = (along * of_size).sum(axis=(3, 4)) + variances[:, None] * (by_size**2).sum()
    cost = (D @ y**2 - np.log(D).sum(axis=1))[:, None] - (b * of_shape).sum(axis=(3, 4))
    cost = cost + np.linalg.slogdet(variances[:, None, None] * K)[1]
    weight = np.exp((cost.min() - cost) / 2)
    mixture = mean.ravel(), np.sqrt(variance).ravel(), (weight / weight.sum()).ravel()
    low, middle, high = (_quantile(p, *mixture) for p in ndtr([-1.0, 0.0, 1.0]))
    return 1 + middle, (high - low) / 2


def _quantile(probability: float, means: Array, deviations: Array, weight: Array) -> float:
    """Of a mixture of normal distributions."""
    ends = (means - 10 * deviations).min(), (means + 10 * deviations).max()
    found = root_scalar(lambda x: weight @ ndtr((x - means) / deviations) - probability, bracket=ends)
    return float(found.root)


def check_shape(adjusted: Adjusted) -> None:
    """Raise CalibrationError where the wand differs much and it is not known which of its distances is right."""
    shape = measure_shape(adjusted)
    if shape is not None and shape.size[1] > MAX_SIGMA and shape.sentence():
        raise CalibrationError(f"{shape.sentence()}; measure the wand again")
