# SPDX-License-Identifier: BSD-3-Clause
"""Estimates the time offsets of all cameras together from moving robots; docs/design/time_offsets.md derives it.

A stamp that is off by d moves a detection by d times the image velocity of its marker; a camera that was moved
slightly shifts all detections alike. Poses and velocities of the robots are free in each frame set, so the estimate
depends on no history: it compares the cameras of the set with each other.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from camera_node.foundation.arrays import Array, Index, Mask
from fusion.model.frames import COV
from fusion.model.observations import CameraArray, MatchedObservations
from fusion.model.states import POSITION, THETA, States

SLACK_PX = 0.5  # of calibration errors, in quadrature to the noise of a detection
FREE = [0, 1, 2, 3, 4, 5, 9, 10, 11]  # pose and velocity of a state, which a wrong clock displaces too
WEAK = 1.0  # prior information about rotations and positions, 1 / rad^2 and 1 / m^2
REWEIGHTED = 1  # times: by the residuals that offsets do not explain
CAUCHY = 4.0  # standard deviations, as in docs/design/fusion_filter.md section 4
SHIFT_PX = 2.0  # prior standard deviation of the shift of an image by calibration errors or a touch
SIGMAS = 5.0  # by which an offset must differ from those of the majority
EXPLAINED = 0.85  # of the contradiction, by the cameras at fault
MAX_GROUP = 3  # cameras at fault at the same time


@dataclass(frozen=True, slots=True, eq=False)
class OffsetInformation:
    """Least squares about the time offsets and image shifts of C cameras: M (offsets, shifts) = y.

    Attributes:
        M: (3 C, 3 C) information: offsets in s, then the shifts (u, v) of each camera in px.
        y: (3 C,) right side.
        motion_px2: (C,) sum of squared image speeds, px^2/s^2; with `count` (C,) detections.
    """

    M: Array
    y: Array
    motion_px2: Array
    count: Array

    @classmethod
    def none(cls, n_cameras: int) -> "OffsetInformation":
        """No information about this many cameras."""
        zeros = np.zeros(n_cameras)
        return cls(np.zeros((3 * n_cameras, 3 * n_cameras)), np.zeros(3 * n_cameras), zeros, zeros)

    def plus(self, other: "OffsetInformation", share: float = 1.0) -> "OffsetInformation":
        """The sum of both, the other one with a weight."""
        return OffsetInformation(*(getattr(self, k) + share * getattr(other, k) for k in self.__slots__))

    def relative_to(self, offsets: Array) -> "OffsetInformation":
        """The same about the offsets (C,) minus these."""
        return replace(self, y=self.y - self.M[:, : len(offsets)] @ offsets)

    def without_shifts(self) -> tuple[Array, Array]:
        """M (C, C) and y (C,) of the offsets alone, if no image is shifted."""
        n = len(self.count)
        return self.M[:n, :n], self.y[:n]

    def with_unknown_shifts(self) -> tuple[Array, Array]:
        """M (C, C) and y (C,) of the offsets alone, the shifts eliminated."""
        n = len(self.count)
        S = self.M[n:, n:] + np.eye(2 * n) / SHIFT_PX**2
        eliminated = np.linalg.solve(S, np.column_stack([self.M[n:, :n], self.y[n:]]))
        return self.M[:n, :n] - self.M[:n, n:] @ eliminated[:, :-1], self.y[:n] - self.M[:n, n:] @ eliminated[
            :, -1
        ]


@dataclass(frozen=True, slots=True, eq=False)
class Disagreement:
    """Cameras whose clocks contradict the others.

    Attributes:
        cameras: indices of the smallest group whose offsets explain the contradiction; empty if several groups of less
            than half of the cameras do, or none.
        offsets_s, sigma_s: of these, by which the clocks differ from those of the others.
        spread_s: RMS of the offsets of all cameras.
    """

    cameras: tuple[int, ...] = ()
    offsets_s: tuple[float, ...] = ()
    sigma_s: tuple[float, ...] = ()
    spread_s: float = 0.0

    @property
    def columns(self) -> tuple[tuple[int, ...], tuple[float, ...], tuple[float, ...]]:
        """Cameras, offsets and standard deviations."""
        return self.cameras, self.offsets_s, self.sigma_s


def offset_information(
    cameras: CameraArray,
    states: States,
    observations: MatchedObservations,
    single: Mask,
    sigma_v: float,
) -> OffsetInformation:
    """The information of one frame set about the time offsets of the cameras; the states of robots are eliminated.

    Args:
        cameras: C cameras.
        states: bodies at the time of the frame set.
        observations: N detections with their discs.
        single: as in `Estimator`.
        sigma_v: prior standard deviation of the velocities in `states`, m/s.
    """
    n = len(cameras.names)
    if not len(observations):
        return OffsetInformation.none(n)
    A, g, e = _equations(cameras, states, observations, single)
    camera = observations.detections.camera
    D = np.concatenate([A, g[:, :, None], _whitened_shifts(observations), e[:, :, None]], 2)
    rows = OffsetEquations.of(D, observations.discs.body, camera, n)
    states_prior = np.repeat([WEAK, WEAK, 1 / sigma_v**2], 3)
    prior = np.concatenate([np.full(n, 1.0), np.full(2 * n, 1 / SHIFT_PX**2)])
    reduced, by_pose = rows.eliminate(np.ones(len(e)), states_prior)
    for _ in range(REWEIGHTED):
        solution = np.asarray(np.linalg.solve(reduced[:, :-1] + np.diag(prior), reduced[:, -1]), float)
        squared = rows.squared_residuals(solution, by_pose[:, :, -1] - by_pose[:, :, :-1] @ solution)
        reduced, by_pose = rows.eliminate(1 / (1 + squared / CAUCHY**2), states_prior)
    return OffsetInformation(
        reduced[:, :-1],
        reduced[:, -1],
        np.bincount(camera, np.sum(g**2, axis=1) * _variance_px2(observations), n).astype(float),
        np.bincount(camera, minlength=n).astype(float),
    )


@dataclass(frozen=True, slots=True, eq=False)
class OffsetEquations:
    """Linear equations of N detections, in the order of B bodies and, for each, of C cameras.

    The unknowns are the free states of the bodies, then the time offsets of the cameras, then their image shifts. A
    detection concerns one body and one camera, so the normal equations are sums over the P pairs of both, and the
    bodies are eliminated one by one (Hartley and Zisserman, A6.3).

    Attributes:
        D: (N, 2, 13) derivatives by the state of the body, by offset and shift of the camera, and the residuals.
        pair: (N,) of each detection.
        body: (P,) of each pair.
        columns: (P, 3) of each pair's camera, among offsets and shifts.
        n_columns: 3 C.
    """

    D: Array
    pair: Index
    body: Index
    columns: Index
    n_columns: int

    @classmethod
    def of(cls, D: Array, body: Index, camera: Index, n_cameras: int) -> "OffsetEquations":
        """From `D` in any order, and the body and the camera (N,) of each detection."""
        key = np.unique(body, return_inverse=True)[1] * n_cameras + camera
        order = np.argsort(key)
        pairs, pair = np.unique(key[order], return_inverse=True)
        camera = pairs % n_cameras
        columns = np.stack([camera, n_cameras + 2 * camera, n_cameras + 2 * camera + 1], 1)
        return cls(D[order], pair, pairs // n_cameras, columns, 3 * n_cameras)

    def eliminate(self, weights: Array, states_prior: Array) -> tuple[Array, Array]:
        """Eliminate the states of the bodies from the weighted normal equations.

        Args:
            weights: (N,) of the detections.
            states_prior: (9,) information about each body's state.

        Returns:
            reduced: (3 C, 3 C + 1) matrix of the offsets and shifts, and their right side.
            by_pose: (B, 9, 3 C + 1) inverse of each body's block times its border and its right side.
        """
        k, m = len(FREE), self.n_columns
        weighted = self.D * weights[:, None, None]
        sums = np.add.reduceat(self.D.transpose(0, 2, 1) @ weighted, _firsts(self.pair))
        bodies = np.add.reduceat(sums, _firsts(self.body))
        border = np.zeros((len(bodies), k, m + 1))
        border[self.body[:, None], :, self.columns] = sums[:, :k, k:-1].transpose(0, 2, 1)
        border[:, :, -1] = bodies[:, :k, -1]
        by_pose: Array = np.asarray(np.linalg.solve(bodies[:, :k, :k] + np.diag(states_prior), border), float)
        reduced: Array = np.zeros((m, m + 1))
        np.add.at(reduced, (self.columns[:, :, None], self.columns[:, None]), sums[:, k:-1, k:-1])
        np.add.at(reduced[:, -1], self.columns, sums[:, k:-1, -1])
        reduced -= border[:, :, :-1].reshape(-1, m).T @ by_pose.reshape(-1, m + 1)
        return reduced, by_pose

    def squared_residuals(self, by_camera: Array, states: Array) -> Array:
        """(N,) squared residuals of a solution: offsets and shifts (3 C,), and states (B, 9)."""
        unknowns = np.concatenate([states[self.body], by_camera[self.columns]], 1)[self.pair]
        return np.sum((self.D[:, :, -1] - (self.D[:, :, :-1] @ unknowns[:, :, None])[:, :, 0]) ** 2, 1)


def _firsts(sorted_indices: Index) -> Index:
    """The first place of each value in an ascending list."""
    return np.flatnonzero(np.diff(sorted_indices, prepend=-1))


def contradiction(
    M: Array, y: Array, motion_px: Array, min_shift_px: float, noise_chi2: float = 0.0
) -> Disagreement | None:
    """The smallest group of cameras whose parameters alone explain what all parameters together do.

    A common parameter of all cameras is unobservable: those of the others are zero.

    Args:
        M, y: (C, C) and (C,) least squares about one parameter of each camera, M x = y.
        motion_px: (C,) RMS image motion for each unit of the parameter; 0 without observations.
        min_shift_px: RMS image motion that a parameter must explain.
        noise_chi2: how much of the contradiction may be noise and stay unexplained.
    """
    known = np.flatnonzero((motion_px > 0) & (np.diag(M) > 1.0))
    M, y, motion_px = M[np.ix_(known, known)], y[known], motion_px[known]
    if len(known) < 2 or float(np.max(np.abs(y) / np.diag(M) * motion_px)) < min_shift_px:
        return None
    offsets = np.linalg.pinv(M, rcond=1e-6, hermitian=True) @ y
    total = float(y @ offsets)
    if total < SIGMAS**2:
        return None
    group = _smallest_group(M, y, min(EXPLAINED * total, total - noise_chi2))
    if not group:
        return Disagreement(spread_s=float(np.std(offsets)))
    inverse = np.linalg.inv(M[np.ix_(group, group)])
    found, sigma = inverse @ y[list(group)], np.sqrt(np.diag(inverse))
    shift_px = np.abs(found) * motion_px[list(group)]
    if (np.abs(found) < SIGMAS * sigma).any() or (shift_px < min_shift_px).any():
        return None
    cameras = tuple(known[list(group)].tolist())
    return Disagreement(cameras, tuple(found.tolist()), tuple(sigma.tolist()), float(np.std(offsets)))


def _smallest_group(M: Array, y: Array, explained: float) -> tuple[int, ...]:
    """The only smallest group of less than half of the cameras that explains so much; empty if there is none."""
    n = len(y)
    for size in range(1, min((n - 1) // 2, MAX_GROUP) + 1):
        groups = np.array(list(combinations(range(n), size)))
        right = y[groups]
        solved = np.linalg.solve(M[groups[:, :, None], groups[:, None]], right[..., None])[..., 0]
        good = np.flatnonzero(np.sum(right * solved, 1) >= explained)
        if len(good):
            return tuple(groups[good[0]].tolist()) if len(good) == 1 else ()
    return ()


def _equations(
    cameras: CameraArray, states: States, observations: MatchedObservations, single: Mask
) -> tuple[Array, Array, Array]:
    """Whitened derivatives by `FREE` (N, 2, 9) and by the time (N, 2), and residuals (N, 2); zero if not visible."""
    discs, seen = observations.discs, observations.detections
    cov = seen.cov + SLACK_PX**2 * np.eye(2)[:, :, None]
    whiten = MatchedObservations.of_discs(seen.replaced(COV, cov), discs).whiten
    poses = cameras.frame_poses(states, seen.exposures)
    rows = poses.linearize_centres(discs.columns, seen.xy, whiten, single)
    spin = np.einsum("nji,nj->ni", states.R, states.omega)[discs.body]  # body frame
    g = np.einsum("nai,ni->na", rows[:, :, THETA], spin)
    g += np.einsum("nai,ni->na", rows[:, :, POSITION], states.v[discs.body])
    return rows[:, :, FREE], g, rows[:, :, 12]


def _whitened_shifts(observations: MatchedObservations) -> Array:
    """(N, 2, 2) whitened derivatives by a shift of the image: L^-1, where L L^T is the covariance."""
    cov = observations.detections.cov + SLACK_PX**2 * np.eye(2)[:, :, None]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cov.transpose(2, 0, 1))), float)


def _variance_px2(observations: MatchedObservations) -> Array:
    """(N,) mean variance of a whitened coordinate, px^2."""
    return observations.detections.variance_px2 + SLACK_PX**2
