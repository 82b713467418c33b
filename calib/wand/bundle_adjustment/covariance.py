# SPDX-License-Identifier: BSD-3-Clause
"""The covariance of adjusted cameras, and the priors of their lenses, which the same information gives.

A lens model that does not fit exactly causes residuals that are alike while the wand is near the same place, for about
a second; a covariance that takes every frame as independent is then too small. The cluster-robust (sandwich) covariance
corrects that (Liang and Zeger 1986; Cameron and Miller 2015): with the scores s_b, summed over blocks of time, and the
information H, it is H^-1 (sum_b s_b s_b^T) H^-1, and equals H^-1 where residuals are independent. A minute has too few
blocks for every entry, but enough for one factor: the mean of its eigenvalues over those of H^-1.

The prior of a lens is its own calibration's standard deviations, or an estimate from the wand recording: a lens file
without standard deviations may come from a data sheet or from a careful calibration. The recording corrects many lenses
and so estimates how far off they are (empirical Bayes: Efron and Morris 1973): the deviation that lenses share, by kind
of parameter, has a marginal likelihood. In the estimate, its prior is a mixture (spike and slab; Mitchell and Beauchamp
1988): exact with probability 1/2, else of any order of magnitude, so exact lenses lose no accuracy. For the covariance,
its prior is flat up to about the usual deviation, with a tail beyond (Student's distribution; Gelman 2006), so errors
that the recording cannot show count in full. docs/design/wand_adjustment.md has the equations.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from calib.rig.camera import LENS, Camera, stated_sigma, with_distortion
from calib.rig.estimation import CHANCE
from calib.wand.bundle_adjustment.problem import Adjusted, Problem, invert_information
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.lens import Lens

BLOCK_S = 1.0  # longer than the wand stays in one place
BLOCKS = 10  # of frame sets in order, where these may be any time apart
MIN_BLOCKS = 4  # fewer do not show a correlation
# Usual standard deviations of the parameters of a lens whose file has none, between a data sheet, or a careless
# calibration, and the true lens: log f, the principal point (share of the longer side), k1, log fx / fy, and the
# distortion coefficients after k1.
FOCAL, CENTRE, K1, RATIO, HIGHER = 0.03, 0.02, 0.1, 0.01, (0.1, 0.005, 0.005, 0.1)
# Of log f of a lens of which only the image size is known: uniform between half and twice the guess.
UNKNOWN_FOCAL = np.log(2) / np.sqrt(3)
# Factors of these for a lens that the recording shows to be farther off: a file of another lens, or none.
WIDER = np.array([15.0, 4.0, 4.0, 5.0, 4.0, 4.0, 2.0, 2.0, 4.0])
UNCOMMON = 0.1  # part of the errors of fx and fy that is not common to both
# Deviations that lenses may share, as shares of the usual ones up to those of another lens, and their prior
# probabilities: for the estimate, and for the covariance Student's distribution with three degrees of freedom and the
# variance of shares that are uniform up to the usual deviation.
SHARES = np.concatenate([[0.0], np.geomspace(1e-3, WIDER.max(), 43)])
SPIKE_AND_SLAB = np.where(SHARES > 0, 0.5 / (len(SHARES) - 1), 0.5)
STUDENT = SHARES * (1 + 3 * SHARES**2) ** -2
STUDENT = STUDENT / STUDENT.sum()
MIN_SHARE = 1e-5  # of the usual deviations: practically exact
# Of the parameters: focal length, principal point, k1 and k2, ratio, p1 and p2, k3 (of a fisheye: k3 and k4, none).
KINDS = np.array([0, 1, 1, 2, 3, 2, 4, 4, 5])
SWEEPS = 4  # over the kinds, each conditional on the others


@dataclass(frozen=True, slots=True)
class CameraCovariance:
    """The covariance of all cameras' free parameters; zero for cameras that were not estimated.

    It refers to the world and the time that the cameras define on average (inner constraints; Triggs et al., Bundle
    Adjustment, section 9.3); where some cameras are fixed, to the world of these, which count as exact.

    Attributes:
        free: indices of the d parameters (`calib.rig.camera`).
        noise: (C, d, C, d) the part from measurement noise, as the residuals show it.
        by_prior: (C, d, S d) P: change of each parameter when the given value of a parameter, last axis, is off by its
            standard deviation (`Problem.prior_sigma`). P P^T is the part from priors: more recordings of the
            wand do not reduce it.
        joint: (C, d, C, d) the sum of both.
    """

    free: tuple[int, ...]
    noise: Array
    by_prior: Array
    joint: Array

    def of(self, parameters: tuple[int, ...]) -> Array:
        """(C, p, C, p) that of some of the parameters; zero where they were not free."""
        count = len(self.joint)
        full = np.zeros((count, len(parameters)) * 2)
        present = [k for k, p in enumerate(parameters) if p in self.free]
        at = [self.free.index(parameters[k]) for k in present]
        full[np.ix_(range(count), present, range(count), present)] = self.joint[:, at][:, :, :, at]
        return full


def camera_covariance(adjusted: Adjusted) -> CameraCovariance:
    """Compute the covariance of an adjustment's cameras."""
    problem, inverse, root = adjusted.problem, inverse_information(adjusted), _prior_root(adjusted)
    shape, rows = (len(problem.lenses), len(problem.free)), problem.estimated_rows()
    size = shape[0] * shape[1]
    by_root = inverse * root
    given = problem.prior_sigma(of_covariance=True).ravel()[rows]
    noise, by_prior = np.zeros((size, size)), np.zeros((size, len(rows)))
    noise[np.ix_(rows, rows)] = adjusted.scale**2 * adjusted.inflation * (inverse - by_root @ by_root.T)
    by_prior[rows] = inverse * (root**2 * np.where(root > 0, given, 0.0))
    noise, by_prior = noise.reshape(*shape, *shape), by_prior.reshape(*shape, -1)
    joint = noise + np.einsum("cpm,eqm->cpeq", by_prior, by_prior)
    return CameraCovariance(problem.free, noise, by_prior, joint)


def inverse_information(adjusted: Adjusted) -> Array:
    """(S d, S d) pseudo-inverse of the information, without the gauge."""
    return invert_information(adjusted.problem, adjusted.state, adjusted.information)


def _prior_root(adjusted: Adjusted) -> Array:
    """(S d,) square root of the priors' information."""
    return 1 / adjusted.problem.prior_sigma().ravel()[adjusted.problem.estimated_rows()]


def inflation_factor(adjusted: Adjusted) -> float:
    """The factor of the covariance for residuals correlated in time, at least 1: the estimated motion absorbs errors,
    so an estimate below 1 means nothing."""
    first = _first_intervals(adjusted.problem)
    if len(first) < MIN_BLOCKS:
        return 1.0
    # Each background point is a block of its own.
    first = np.append(first, np.arange(len(adjusted.problem.knot_s) - 1, len(adjusted.scores)))
    # At the optimum the scores sum to minus the priors' gradient: one degree of freedom of the blocks.
    scores = np.add.reduceat(adjusted.scores, first)
    scores = scores - scores.mean(axis=0)
    inverse = inverse_information(adjusted)
    squares = float(((scores @ inverse) * scores).sum()) / adjusted.scale**2
    # The number of parameters that the observations determine; those that only a prior determines do not count.
    determined = float(np.trace(inverse @ (adjusted.information - np.diag(_prior_root(adjusted) ** 2))))
    return max(squares / determined * len(scores) / (len(scores) - 1), 1.0)


def _first_intervals(problem: Problem) -> Index:
    """The first interval between knots of every block: of one second, or of a tenth of the frame sets of
    synchronous cameras."""
    knot_s = problem.knot_s[:-1]
    by_count, by_time = np.arange(len(knot_s)) * BLOCKS // len(knot_s), (knot_s - knot_s[0]) // BLOCK_S
    return np.flatnonzero(np.diff(by_count if problem.gap_s == 0 else by_time, prepend=-1))


def usual_sigma(lens: Lens) -> Array:
    """(9,) usual standard deviations of the parameters (`LENS`) of a lens whose file has none."""
    size = max(lens.width, lens.height)
    return np.array([FOCAL, CENTRE * size, CENTRE * size, K1, RATIO, *HIGHER])


def unknown_sigma(lens: Lens) -> Array:
    """(9,) standard deviations of the parameters of a lens that is known by its image size alone."""
    sigma = usual_sigma(lens)
    sigma[0] = UNKNOWN_FOCAL
    return sigma


def calibrated_sigma(lens: Lens) -> Array | None:
    """(9,) standard deviations of the parameters (`LENS`) from the lens's file; None where it has none.

    The file does not state how fx and fy are correlated. They are nearly equal in relative terms, so the part of their
    errors that is not common, and changes fx / fy, counts as a tenth. Deviations of 0 declare a lens exact, and
    coefficients after k1 without one count as exact.
    """
    if not isinstance(lens, Camera) or lens.lens_sigma is None:
        return None
    fx, fy, cx, cy, *distortion = lens.lens_sigma
    focal = np.hypot(fx / lens.fx, fy / lens.fy) / np.sqrt(2)
    k1, *higher = distortion or [K1]
    higher = [*higher, 0.0, 0.0, 0.0, 0.0][:4]
    return np.maximum(
        [focal, cx, cy, k1, min(UNCOMMON * focal, RATIO), *higher], MIN_SHARE * usual_sigma(lens)
    )


def coarse_sigma(lens: Lens) -> Array:
    """(9,) prior standard deviations before the recording decides: the usual ones, or larger ones of the file."""
    given = calibrated_sigma(lens)
    return usual_sigma(lens) if given is None else np.maximum(usual_sigma(lens), given)


def widen_lenses(cameras: Mapping[str, Camera], factor: float) -> dict[str, Camera]:
    """The cameras with the standard deviations of all lenses multiplied by `factor`; a lens whose file has none gets
    the usual ones, multiplied."""
    widened = {}
    for name, given in cameras.items():
        camera = with_distortion(given)
        sigma = camera.lens_sigma or parameter_sigma(camera, None, usual_sigma(camera))
        widened[name] = msgspec.structs.replace(camera, lens_sigma=tuple(factor * value for value in sigma))
    return widened


def parameter_sigma(lens: Lens, before: tuple[float, ...] | None, sigma: Array) -> tuple[float, ...]:
    """`Camera.lens_sigma` of an adjusted lens.

    Args:
        lens: the adjusted lens.
        before: `lens_sigma` of its file, which stays for parameters that are not adjusted; these count as exact
            without it.
        sigma: (9,) standard deviations of the adjusted parameters (`LENS`).
    """
    focal, cx, cy, k1, ratio, *higher = sigma.tolist()
    focal = float(np.hypot(focal, ratio / 2))
    count = len(lens.parameters)
    rest = (*(before or ()), *[0.0] * count)[9:count]
    return stated_sigma(lens, (focal * lens.fx, focal * lens.fy, cx, cy, k1, *higher, *rest)[:count])


def estimate_lens_priors(problem: Problem, adjusted: Adjusted) -> Problem:
    """The problem with lens priors from an adjustment of the same recording.

    Standard deviations from a lens's file hold unless the recording contradicts them. For all other lenses the
    recording gives a deviation by kind of parameter. Fixed cameras keep their priors.

    Args:
        problem: to change.
        adjusted: an adjustment of the recording with any lens priors.
    """
    estimated = list(adjusted.problem.estimated_cameras())
    information, gradient = _lens_likelihood(adjusted)
    sigma, unknown = _choose_sigma(adjusted.problem, information, gradient)
    prior, wider = problem.lens_sigma.copy(), problem.lens_sigma.copy()
    # The smoothness of the motion between frames biases what images hardly determine: to lenses that are farther off.
    most = np.inf if adjusted.problem.gap_s == 0 else 1.0
    estimate, claim = (np.where(most >= SHARES, p, 0.0) for p in (SPIKE_AND_SLAB, STUDENT))
    prior[estimated] = sigma * estimate_shares(information, gradient, sigma, unknown, estimate)
    heavy = sigma * estimate_shares(information, gradient, sigma, unknown, claim)
    wider[estimated] = np.maximum(heavy, prior[estimated])
    return replace(problem, lens_sigma=prior, covariance_lens_sigma=wider)


def _lens_likelihood(adjusted: Adjusted) -> tuple[Array, Array]:
    """(9S, 9S) information of the observations alone on the S estimated lenses, and (9S,) its product with their
    maximum-likelihood estimate."""
    problem = adjusted.problem
    estimated, d = list(problem.estimated_cameras()), len(problem.free)
    rows = np.ravel(np.arange(len(estimated))[:, None] * d + [problem.free.index(p) for p in LENS])
    variance = adjusted.scale**2 * adjusted.inflation
    with_prior = np.linalg.inv(inverse_information(adjusted)[np.ix_(rows, rows)])
    prior = np.diag(problem.lens_sigma[estimated].ravel() ** -2)
    return (with_prior - prior) / variance, with_prior @ adjusted.state.lenses[estimated].ravel() / variance


def lens_evidence(adjusted: Adjusted, instead: Array) -> float:
    """Logarithm of the Bayes factor of other lenses, as corrections (C, 9) of the given ones, over the given ones.

    In either case the true lenses are off by a share of the usual standard deviations, or of larger ones of their
    files, that they have in common, so that two sets of lenses are distinguished as far as the recording determines
    the lenses. No recording is taken to be better than its detections claim: without noise, rounding would decide.
    """
    claimed = min(1.0, adjusted.scale**2 * adjusted.inflation)
    information, gradient = (claimed * part for part in _lens_likelihood(adjusted))
    estimated = list(adjusted.problem.estimated_cameras())
    off = instead[estimated].ravel()
    sigma = np.array([coarse_sigma(adjusted.problem.lenses[k]) for k in estimated]).ravel()

    def evidence(off: Array) -> float:
        likelihood = _log_marginals(information, gradient - information @ off, sigma)
        return float(np.logaddexp.reduce(likelihood[1:] + np.log(STUDENT[1:])))

    return evidence(off) - evidence(0 * off) + float(off @ gradient - off @ information @ off / 2)


def _choose_sigma(problem: Problem, information: Array, gradient: Array) -> tuple[Array, Mask]:
    """(S, 9) standard deviations of the estimated lenses: from their files where the recording does not contradict
    them, else the usual ones, or wider ones where it contradicts these too; and which (S, 9) are the usual ones, of
    `unknown` size."""
    lenses, size = [problem.lenses[k] for k in problem.estimated_cameras()], len(KINDS)
    sigma, unknown = np.array([usual_sigma(lens) for lens in lenses]), np.ones((len(lenses), size), bool)
    # With wider priors, a recording that does not determine a lens would contradict any: the equations are linear only
    # near the adjustment.
    covariance = np.asarray(np.linalg.inv(information + np.diag(sigma.ravel() ** -2)), float)
    correction = (covariance @ gradient).reshape(-1, size)
    for k, lens in enumerate(lenses):
        block, given = covariance[size * k :, size * k :][:size, :size], calibrated_sigma(lens)
        if given is not None and _plausible(correction[k], block + np.diag(given**2)):
            sigma[k], unknown[k] = given, given >= usual_sigma(lens)
        elif not _plausible(correction[k], block + np.diag(sigma[k] ** 2)):
            sigma[k], unknown[k] = WIDER * sigma[k], False
    return sigma, unknown


def _plausible(correction: Array, covariance: Array) -> bool:
    from scipy.special import chdtrc

    squared = correction @ np.linalg.solve(covariance, correction)
    return bool(chdtrc(len(correction), squared) > CHANCE)


def estimate_shares(information: Array, gradient: Array, sigma: Array, unknown: Mask, prior: Array) -> Array:
    """(S, 9) share of `sigma` that lenses of `unknown` deviation are off by, the same for all parameters of a kind: the
    root of the posterior mean of its square under `prior`, one kind after the other; 1 for other lenses."""
    shares = np.ones(len(KINDS))
    for kind in np.tile(np.unique(KINDS[unknown.any(axis=0)]), SWEEPS):
        deviations = (np.where(unknown, shares, 1.0) * sigma).ravel()
        of_kind = np.ravel(unknown & (kind == KINDS))
        seen = _integrate_out(information, gradient, ~of_kind, deviations)
        likelihood = _log_marginals(*seen, sigma.ravel()[of_kind])
        # A share that the prior excludes may be so much likelier that the weights of all others would be 0.
        weight = prior * np.exp(np.minimum(likelihood - likelihood[prior > 0].max(), 0.0))
        shares[kind == KINDS] = max(np.sqrt(weight @ SHARES**2 / weight.sum()), MIN_SHARE)
    return np.where(unknown, shares, 1.0)


def _integrate_out(information: Array, gradient: Array, others: Mask, sigma: Array) -> tuple[Array, Array]:
    """The information and gradient that remain of n parameters without the `others` (n,), whose priors have the
    deviations `sigma` (n,), which may be 0."""
    S, rest = sigma[others], ~others
    crossed = S[:, None] * information[others][:, rest]
    known = np.eye(len(S)) + S[:, None] * information[others][:, others] * S
    response = np.linalg.solve(known, np.column_stack([crossed, S * gradient[others]]))
    remaining = information[rest][:, rest] - crossed.T @ response[:, :-1]
    return remaining, gradient[rest] - crossed.T @ response[:, -1]


def _log_marginals(information: Array, gradient: Array, sigma: Array) -> Array:
    """(t,) log marginal likelihoods of the t `SHARES` s of deviations `sigma` (n,), with information L and gradient g,
    parameters integrated out: with S = diag(sigma) and the eigenvalues w and eigenvectors V of S L S, the sum of
    (s V^T S g)^2 / (1 + s^2 w) / 2 - log(1 + s^2 w) / 2."""
    w, V = np.linalg.eigh(sigma[:, None] * information * sigma)
    squares, w = SHARES[:, None] ** 2, np.maximum(w, 0.0)  # rounding
    projected = V.T @ (sigma * gradient)
    return np.asarray(
        (squares * projected**2 / (1 + squares * w) - np.log1p(squares * w)).sum(axis=1) / 2, float
    )
