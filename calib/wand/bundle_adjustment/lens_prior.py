# SPDX-License-Identifier: BSD-3-Clause
"""How well a lens is known before the wand is waved: by its own calibration, or as lenses without figures are.

Files without figures range from a data sheet to a careful calibration. How far off such lenses are, the wave itself
tells, as it changes many of them (empirical Bayes: Efron and Morris 1973): by the marginal likelihood of the deviation
that those of a kind share. Lenses are held as if they were exact in one file of two, else off by any order of
magnitude (spike and slab; Mitchell and Beauchamp 1988): good ones cost nothing. Covariances do not believe that. For
them the deviation is uniform between none and the usual before anything is seen (Gelman 2006): what a lens may be off
by without the wave showing it counts in full.
"""

from dataclasses import replace

import numpy as np

from calib.rig.camera import LENS, Camera
from calib.wand.bundle_adjustment.optimizer import Adjusted
from calib.wand.bundle_adjustment.problem import Problem
from camera_node.arrays import Array, Mask
from camera_node.geometry.lens import Lens

# Of log f, the principal point (part of the longer side) and k1, for a lens whose file says nothing: what lies between
# a data sheet, or a sloppy board, and the lens that is there.
FOCAL, CENTRE, K1 = 0.03, 0.02, 0.1
# No lens is as it was calibrated to better than this: focus, temperature, a camera that was taken off its mount.
FLOOR = np.array([5e-4, 0.3, 0.3, 5e-4])
WRONG = 1e-4  # probability below which a lens is not what its figures say
PARTS = np.concatenate(
    [[0.0], np.geomspace(1e-3, 1.0, 31)]
)  # of the usual deviations, by which lenses may be off
# Probabilities of these before anything is seen: to hold lenses by, and for covariances.
SPIKE, UNIFORM = np.where(PARTS > 0, 0.5 / (len(PARTS) - 1), 0.5), PARTS / PARTS.sum()
LEAST = 1e-5  # of the usual deviations: exact, and yet a number
KINDS = np.array([0, 1, 1, 2])  # of the four, that are off alike: focal length, principal point, distortion
SWEEPS = 4  # over the kinds, each given the others


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


def settle(problem: Problem, adjusted: Adjusted) -> Problem:
    """The problem with lenses held by what a wave tells of them.

    Figures that stand with a lens hold unless the wave contradicts them. Of all others the wave itself tells how far
    off they are, by kind of parameter. Cameras that are not sought keep theirs.

    Args:
        problem: to change.
        adjusted: the wave, adjusted with lenses held by whatever there was.
    """
    sought = list(adjusted.problem.cameras())
    information, gradient = _told_by_wave(adjusted)
    sigma, rough = _known(adjusted.problem, information, gradient)
    held, doubt = problem.lens_sigma.copy(), problem.lens_sigma.copy()
    held[sought] = sigma * _parts(information, gradient, sigma, rough, SPIKE)
    doubt[sought] = np.maximum(sigma * _parts(information, gradient, sigma, rough, UNIFORM), held[sought])
    return replace(problem, lens_sigma=held, lens_doubt=doubt)


def _known(problem: Problem, information: Array, gradient: Array) -> tuple[Array, Mask]:
    """(S, 4) deviations of the sought lenses, by their figures where these hold, else the usual ones, which are
    `rough`."""
    lenses = [problem.lenses[k] for k in problem.cameras()]
    sigma, rough = np.array([usual_sigma(lens) for lens in lenses]), np.ones((len(lenses), 4), bool)
    covariance = np.linalg.inv(information + np.diag(sigma.ravel() ** -2))
    off = (covariance @ gradient).reshape(-1, 4)
    for k, lens in enumerate(lenses):
        mine, figures = slice(4 * k, 4 * k + 4), told_sigma(lens)
        if figures is not None and _holds(off[k], covariance[mine, mine] + np.diag(figures**2)):
            sigma[k], rough[k] = figures, False
    return sigma, rough


def _holds(off: Array, covariance: Array) -> bool:
    from scipy.special import chdtrc

    return bool(chdtrc(len(off), off @ np.linalg.solve(covariance, off)) > WRONG)


def _parts(information: Array, gradient: Array, sigma: Array, rough: Mask, prior: Array) -> Array:
    """(S, 4) what part of `sigma` the lenses are off by, those of a kind alike: the root of its square's posterior
    mean, one kind after the other, by the `prior` of PARTS; 1 where they are not `rough`."""
    parts = np.ones(len(KINDS))
    for kind in np.tile(np.unique(KINDS), SWEEPS if rough.any() else 0):
        tried = np.where(kind == KINDS, PARTS[:, None], parts)
        trials = np.where(rough, tried[:, None], 1.0) * sigma
        likely = _log_marginals(information, gradient, trials.reshape(len(PARTS), -1))
        weight = prior * np.exp(likely - likely.max())
        parts[kind == KINDS] = max(np.sqrt(weight @ PARTS**2 / weight.sum()), LEAST)
    return np.where(rough, parts, 1.0)


def _told_by_wave(adjusted: Adjusted) -> tuple[Array, Array]:
    """(4S, 4S) information on the S sought lenses by what was seen alone, and (4S,) its product with their estimate."""
    problem = adjusted.problem
    sought, d = list(problem.cameras()), len(problem.free)
    mine = np.ravel(np.arange(len(sought))[:, None] * d + [problem.free.index(p) for p in LENS])
    noise = adjusted.scale**2 * adjusted.dependence
    whole = np.linalg.inv(adjusted.inverse()[np.ix_(mine, mine)])
    known = np.diag(problem.lens_sigma[sought].ravel() ** -2)
    return (whole - known) / noise, whole @ adjusted.state.lenses[sought].ravel() / noise


def _log_marginals(information: Array, gradient: Array, sigma: Array) -> Array:
    """(t,) log likelihoods of parameters' deviations (t, n), the parameters integrated out: with S = diag(sigma),
    g^T S (1 + S L S)^-1 S g / 2 - log det(1 + S L S) / 2."""
    root = np.linalg.cholesky(np.eye(len(gradient)) + sigma[:, :, None] * information * sigma[:, None])
    pulled = np.linalg.solve(root, (sigma * gradient)[:, :, None])[:, :, 0]
    return np.asarray((pulled**2).sum(axis=1) / 2 - np.log(np.einsum("tnn->tn", root)).sum(axis=1), float)


def written(lens: Lens, before: tuple[float, ...] | None, sigma: Array) -> tuple[float, ...]:
    """`Camera.lens_sigma` of an adjusted lens by `sigma` (4,); what is not adjusted stays as it was, or counts as
    known."""
    focal, cx, cy, k1 = sigma.tolist()
    rest = (*(before or ()), *[0.0] * len(lens.parameters))[5 : len(lens.parameters)]
    return (focal * lens.fx, focal * lens.fy, cx, cy, k1, *rest)
