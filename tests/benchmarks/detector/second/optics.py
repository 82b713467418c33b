# SPDX-License-Identifier: BSD-3-Clause
"""The point spread of a lens with aberrations, by the Fourier transform of its pupil (Goodman, Fourier Optics, ch. 6).

Diffraction, defocus, spherical aberration, and coma and astigmatism that grow with the distance from the axis.

Under coma, edges are not where the centroid of the spread is: 0.06 px farther out in the corners, in proportion to the
distance from the axis. A calibration with the same lens takes that for distortion or focal length. So a point's
position is the one that edges around it show: the mean, over all directions, of the Gaussian edges that are nearest to
the images of straight ones in least squares.
"""

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from scipy import fft

from camera_node.foundation.arrays import Array

CUT_OFF = 1.95  # cycles per pixel: 0.55 um, f/2.8 and pixels of 3 um
DIRECTIONS = 12  # of edges, over half a turn
STEPS = 10
Z = np.linspace(-6, 6, 1201)
PHI = np.array([NormalDist().cdf(z) for z in Z])
REACH = 8  # pixels on either side of the centre


@dataclass(frozen=True)
class Lens:
    """Aberrations at the pupil's edge, waves; coma and astigmatism at a field of 1, the corner of the picture."""

    defocus: float
    spherical: float = 0.1
    coma: float = 0.0
    astigmatism: float = 0.3

    def spread(self, field: Array, pieces: int) -> Array:
        """(n, n) intensity at `pieces` samples per pixel, its edges at sample (0, 0), for a field (2,) within 1."""
        n = 2 * REACH * pieces
        frequency = np.fft.fftfreq(n, 1 / pieces)
        fx, fy = np.meshgrid(frequency, frequency)
        r = np.hypot(fx, fy) / (CUT_OFF / 2)
        far = float(np.hypot(*field))
        along = (fx * field[0] + fy * field[1]) / (CUT_OFF / 2) / max(far, 1e-9)
        waves = (
            self.defocus * r**2
            + self.spherical * r**4
            + self.coma * far * r**2 * along
            + self.astigmatism * far**2 * along**2
        )
        edge = np.clip((1 - r) * CUT_OFF / 2 * n / pieces + 0.5, 0, 1)  # of the pupil, over one sample
        intensity = np.abs(np.fft.ifft2(edge * np.exp(2j * np.pi * waves))) ** 2
        spread = intensity / intensity.sum()
        if not self.coma:
            return spread  # symmetric
        middle = middle_of_edges(spread, pieces)
        shift = np.exp(2j * np.pi * (fx * middle[0] + fy * middle[1]))
        return np.fft.ifft2(np.fft.fft2(spread) * shift).real


def middle_of_edges(spread: Array, pieces: int) -> Array:
    """(2,) pixels: the translation nearest to the positions of straight edges in all directions."""
    place = np.fft.fftfreq(len(spread), pieces / len(spread))
    x, y = (axis.ravel() for axis in np.meshgrid(place, place))
    turn = (np.arange(DIRECTIONS) + 0.3) * np.pi / DIRECTIONS
    normals = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    at = [_position_of_edge(normal @ [x, y], spread.ravel(), pieces) for normal in normals]
    return 2 * np.array(at) @ normals / DIRECTIONS


def _position_of_edge(along: Array, weight: Array, pieces: int) -> float:
    """The position, pixels, of the Gaussian edge nearest to the image of an edge at 0; Gauss-Newton.

    `along` (N,) are the samples' positions across the edge, `weight` (N,) the spread. A pixel's width is included.
    """
    cell = along * pieces + 2 * REACH * pieces
    low = np.floor(cell).astype(np.intp)
    line = np.bincount(low, weight * (low + 1 - cell), 4 * REACH * pieces)
    line += np.bincount(low + 1, weight * (cell - low), 4 * REACH * pieces)
    edge = np.cumsum(np.convolve(line, np.full(pieces, 1 / pieces)))
    x = (np.arange(len(edge)) + 0.5 - (pieces - 1) / 2) / pieces - 2 * REACH
    middle, sigma = 0.0, 0.7
    for _ in range(STEPS):
        z = (x - middle) / sigma
        slope = np.exp(-z * z / 2) / np.sqrt(2 * np.pi) / sigma
        J = np.stack([-slope, -z * slope], axis=1)
        step = np.linalg.solve(J.T @ J, J.T @ (edge - np.interp(z, Z, PHI)))
        middle, sigma = middle + step[0], max(0.2, sigma + step[1])
    return middle


def centroid_of(spread: Array, pieces: int) -> Array:
    """(2,) pixels, from sample (0, 0)."""
    place = np.fft.fftfreq(len(spread), pieces / len(spread))
    return np.array([spread.sum(axis=0) @ place, spread.sum(axis=1) @ place])


def blur(fine: Array, spread: Array) -> Array:
    """The picture (h, w) through a point spread (n, n) whose centre is sample (0, 0); it repeats at the borders."""
    h, w = fine.shape
    n = len(spread)
    kernel = np.zeros((h, w), np.float32)
    kernel[: n // 2, : n // 2] = spread[: n // 2, : n // 2]
    kernel[: n // 2, -n // 2 :] = spread[: n // 2, n // 2 :]
    kernel[-n // 2 :, : n // 2] = spread[n // 2 :, : n // 2]
    kernel[-n // 2 :, -n // 2 :] = spread[n // 2 :, n // 2 :]
    through = np.asarray(fft.rfft2(fine.astype(np.float32))) * np.asarray(fft.rfft2(kernel))
    return np.asarray(fft.irfft2(through, s=(h, w)), float)
