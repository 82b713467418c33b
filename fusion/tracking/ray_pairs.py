# SPDX-License-Identifier: BSD-3-Clause
"""Pairs rays of two cameras into points by the probability that both see the same point.

Two rays of one point miss each other by noise, two others by anything: their misses are uniformly distributed. Each ray
belongs to one point at most, so the pairs compete. With the likelihood ratio x of each pair, the weight of a set of
pairs is the product of their x; sums over all sets give the probability of each pair (the monomer-dimer model), by
belief propagation (Bayati et al. 2007). A pair is a point if it is probable: if no competing pair is comparably likely.

The frame set itself tells the noise, the number of points that two cameras see, and how many rays pass each other by
chance (expectation maximization). docs/design/fusion_filter.md section 7 has the equations.
"""

from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array, Index
from fusion import _core
from fusion.tracking.rays import SIGMAS, Rays, misses, triangulate

PROBABLE = 0.9
FAR = 5.0  # tolerances: within, but beyond one tolerance, rays pass each other by chance
ROUNDS, PASSES = 8, 12  # of expectation maximization, and of messages in each
PRIOR = 3.0  # observations that the initial noise counts for
HALF = 0.5  # Jeffreys' prior of a count
MAX_RATIO = 1e12


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """K pairs of rays within the tolerance of each other.

    Attributes:
        rays: (2, K) rows of the rays.
        miss: (K,) in the standard deviations that the rays state.
        cameras: (K,) number of the pair of frames.
        chance: (G,) misses per standard deviation by chance, of each pair of frames.
        frames: (2, K) rows of the frames; of `n` (F,) rays each.
    """

    rays: Index
    miss: Array
    cameras: Index
    chance: Array
    frames: Index
    n: Index

    @classmethod
    def of(cls, rays: Rays, pairs: Index, miss: Array) -> "_Pairs":
        """Of all pairs (2, K) up to a miss of `FAR` tolerances."""
        n_frames, frames = len(rays.exposures.camera), rays.frame[pairs]
        found, number = np.unique(frames.min(0) * n_frames + frames.max(0), return_inverse=True)
        near = miss < 1
        n_far = np.bincount(number[~near], minlength=len(found))
        chance = np.asarray((n_far + HALF) / (SIGMAS * (FAR - 1)), float)
        n = np.bincount(rays.frame, minlength=n_frames)
        return cls(pairs[:, near], miss[near] * SIGMAS, number[near], chance, frames[:, near], n)

    def ratios(self, probability: Array, sigma: float) -> Array:
        """(K,) likelihood that both rays are of one point, relative to two rays of no pair.

        Args:
            probability: (K,) so far; its sums are the expected numbers of points and of single rays.
            sigma: standard deviation of the misses of points.
        """
        points = np.bincount(self.cameras, probability, len(self.chance)) + HALF
        paired = sum(np.bincount(frame, probability, len(self.n)) for frame in self.frames)
        single = self.n - np.minimum(self.n - HALF, paired) + HALF
        of_point = 2 * np.exp(-((self.miss / sigma) ** 2) / 2) / (np.sqrt(2 * np.pi) * sigma)
        prior = points[self.cameras] * np.prod((self.n / single)[self.frames], 0)
        return np.minimum(prior * of_point / self.chance[self.cameras], MAX_RATIO)


def pair_rays(rays: Rays, sigma: float) -> tuple[Index, Array]:
    """The pairs (2, K) of rays that are points, and the points (K, 3).

    Args:
        rays: of no point that more cameras see.
        sigma: see `misfit_of`.
    """
    given = rays.viewpoints, rays.frame, rays.d, rays.reach, rays.moved, rays.ranges
    rows, (miss, range_m) = _core.ray_pairs(*given, FAR)
    if not (miss < 1).any():
        return np.empty((2, 0), np.intp), np.empty((0, 3))
    pairs = _Pairs.of(rays, rows, miss)
    is_point = _probabilities(pairs, len(rays), sigma) > PROBABLE
    chosen = np.flatnonzero(miss < 1)[is_point]
    first = rows[0, chosen]
    return rows[:, chosen], rays.o[first] + range_m[chosen, None] * rays.d[first]


def misfit_of(rays: Rays, group: Index, centres: Array) -> float:
    """The standard deviation of the misses of grouped rays, relative to what they state; 1 at most.

    The stated noise includes an allowance for calibration errors, which most calibrations do not need.
    """
    points = triangulate(rays, group, centres)[0]
    rows = np.flatnonzero(group >= 0)
    squares = np.sum((SIGMAS * misses(rays, rows, points[group[rows]])) ** 2)
    return float(np.sqrt(min(1.0, (PRIOR + squares) / (PRIOR + 2 * len(rows) - 3 * len(centres)))))


def _probabilities(pairs: _Pairs, n_rays: int, sigma: float) -> Array:
    """(K,) the probability of each pair."""
    probability, variance = np.full(len(pairs.miss), 0.5), sigma**2
    messages = np.full((2, len(pairs.miss)), 0.5)
    for _ in range(ROUNDS):
        ratios = pairs.ratios(probability, np.sqrt(variance))
        probability, messages = _marginals(pairs.rays, ratios, messages, n_rays)
        squares = np.sum(probability * pairs.miss**2)
        variance = min(1.0, (PRIOR * sigma**2 + squares) / (PRIOR + np.sum(probability)))
    return probability


def _marginals(rays: Index, ratios: Array, messages: Array, n_rays: int) -> tuple[Array, Array]:
    """Belief propagation on the monomer-dimer model.

    The message of ray i to ray j is the probability that i is single without the pair (i, j):
    m_ij = 1 / (1 + sum over its other pairs (i, k) of x_ik m_ki).

    Args:
        rays: (2, K) the pairs (i, j).
        ratios: (K,) x of each pair.
        messages: (2, K) of i to j and of j to i, to begin with.
        n_rays: number of all rays.

    Returns:
        (K,) probabilities x m m' / (1 + x m m') of the pairs, and the messages.
    """
    for k in range(PASSES):
        received = ratios * messages[::-1]
        total = np.bincount(rays[0], received[0], n_rays) + np.bincount(rays[1], received[1], n_rays)
        new = 1 / (1 + total[rays] - received)
        messages = (messages + new) / 2 if k % 2 else new
    both = ratios * messages[0] * messages[1]
    return both / (1 + both), messages
