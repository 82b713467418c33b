# SPDX-License-Identifier: BSD-3-Clause
"""How well a lens is known before the wand is waved: by its own calibration, or as lenses without figures are.

Files without figures range from a data sheet to a careful calibration. What is usual for the worst of them holds until
the wave itself shows that they are better (empirical Bayes: Efron and Morris 1973).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib.camera import Camera
from camera_node.lens import Lens

Array = NDArray[np.float64]

# Of log f, the principal point (part of the longer side) and k1, for a lens whose file says nothing: what lies between
# a data sheet, or a sloppy board, and the lens that is there.
FOCAL, CENTRE, K1 = 0.03, 0.02, 0.1
# No lens is as it was calibrated to better than this: focus, temperature, a camera that was taken off its mount.
FLOOR = np.array([5e-4, 0.3, 0.3, 5e-4])
UNLIKELY = 0.05  # probability that lenses are worse than the wave lets them seem
WRONG = 1e-4  # probability below which a lens is not what its figures say
PARTS = np.geomspace(1.0, 1e-3, 61)
KINDS = np.array([0, 1, 1, 2])  # of the four, that are off alike: focal length, principal point, distortion


def usual_sigma(lens: Lens) -> Array:
    """(4,) standard deviations of log f, cx, cy and k1 of a lens without figures."""
    size = max(lens.width, lens.height)
    return np.array([FOCAL, CENTRE * size, CENTRE * size, K1])


def told_sigma(lens: Lens) -> Array | None:
    """(4,) those that stand with the lens; None where none do."""
    if not isinstance(lens, Camera) or lens.lens_sigma is None:
        return None
    fx, fy, cx, cy, *distortion = lens.lens_sigma
    focal = np.hypot(fx / lens.fx, fy / lens.fy) / np.sqrt(2)
    return np.maximum([focal, cx, cy, distortion[0] if distortion else K1], FLOOR)


def settle(lenses: Sequence[Lens], off: Array, covariance: Array) -> Array:
    """(C, 4) standard deviations of lenses, after a wave that was adjusted by the usual ones.

    Figures that stand with a lens hold unless the wave contradicts them. Of all others the wave itself tells how far
    off they are, by kind of parameter.

    Args:
        lenses: those that were given.
        off: (C, 4) what the wave changed of log f, cx, cy and k1.
        covariance: (C, 4, C, 4) of it, prior included.
    """
    usual, told = np.array([usual_sigma(lens) for lens in lenses]), [told_sigma(lens) for lens in lenses]
    settled, rough = usual.copy(), []
    for k, sigma in enumerate(told):
        if sigma is not None and _holds(off[k], covariance[k, :, k] + np.diag(sigma**2)):
            settled[k] = sigma
        else:
            rough.append(k)
    if rough:
        among = covariance[rough][:, :, rough].reshape(4 * len(rough), -1)
        settled[rough] = np.maximum(_parts(off[rough], among, usual[rough]) * usual[rough], FLOOR)
    return settled


def _holds(off: Array, covariance: Array) -> bool:
    from scipy.stats import chi2

    return bool(chi2.sf(off @ np.linalg.solve(covariance, off), len(off)) > WRONG)


def _parts(off: Array, covariance: Array, sigma: Array) -> Array:
    """(4,) by what part of `sigma` (C, 4) lenses are off at the most, those of a kind alike."""
    parts = np.ones(len(KINDS))
    for kind in np.unique(KINDS):
        mine = np.broadcast_to(kind == KINDS, off.shape).ravel()
        cov = covariance[np.ix_(mine, mine)]
        parts[kind == KINDS] = _upper_end(off.ravel()[mine], cov, sigma.ravel()[mine])
    return parts


def written(lens: Lens, before: tuple[float, ...] | None, sigma: Array) -> tuple[float, ...]:
    """`Camera.lens_sigma` of an adjusted lens by `sigma` (4,); what is not adjusted stays as it was, or counts as
    known."""
    focal, cx, cy, k1 = sigma.tolist()
    rest = (*(before or ()), *[0.0] * len(lens.parameters))[5 : len(lens.parameters)]
    return (focal * lens.fx, focal * lens.fy, cx, cy, k1, *rest)


def _upper_end(off: Array, covariance: Array, sigma: Array) -> float:
    """Of a one-sided confidence interval of t, 1 at the most, where n parameters (n,) are N(0, t^2 sigma^2).

    Seen with information L, their gradient L x has, in the eigenvectors of sigma L sigma, variances a + t^2 a^2:
    squares over these, summed, follow chi-square with n degrees. Where a wave says little, a is small, and t stays 1.
    """
    from scipy.stats import chi2

    whole = np.linalg.inv(covariance / np.outer(sigma, sigma))
    seen, along = np.linalg.eigh(whole - np.eye(len(off)))
    seen = np.maximum(seen, 1e-9)
    gradient = along.T @ whole @ (off / sigma)
    squares = (gradient**2 / (seen * (1 + PARTS[:, None] ** 2 * seen))).sum(axis=1)
    likely = squares >= chi2.ppf(UNLIKELY, len(off))
    return float(PARTS[likely.argmax()]) if likely.any() else float(PARTS[-1])
