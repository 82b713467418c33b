# SPDX-License-Identifier: BSD-3-Clause
"""Estimates the time offsets of all cameras together from moving robots; docs/time_offsets.md derives it.

A stamp that is off by d moves a detection by d times the image velocity of its marker; a camera that was moved
slightly shifts all detections alike. The poses of the robots are free in each frame set, so the estimate depends on no
history: it compares the cameras of the set with each other.
"""

from dataclasses import dataclass, replace

import numpy as np

from camera_node.arrays import Array, Index, Mask
from fusion.model.camera_array import CameraArray
from fusion.model.observations import MatchedObservations
from fusion.model.states import POSITION, THETA, States

SLACK_PX = 0.5  # of calibration errors, in quadrature to the noise of a detection
WEAK = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0])  # prior information of a pose, 1 / rad^2 and 1 / m^2
CAUCHY = 4.0  # standard deviations, as in docs/fusion_filter.md section 4
SHIFT_PX = 2.0  # prior standard deviation of the shift of an image by calibration errors or a touch
SIGMAS = 5.0  # by which an offset must differ from those of the majority
SAME_S = 0.0015  # offsets within this and 3 sigma of each other are equal


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
    """Offsets (C,) and their standard deviations relative to the majority, and the cameras that differ from it.

    `has_majority` is False if no largest group of cameras agrees: `outliers` are then all cameras with information.
    """

    offsets_s: Array
    sigma_s: Array
    outliers: Mask
    has_majority: bool


def offset_information(
    cameras: CameraArray, states: States, observations: MatchedObservations, single: Mask
) -> OffsetInformation:
    """The information of one frame set about the time offsets of the cameras; poses of robots are eliminated.

    Args:
        cameras: C cameras.
        states: bodies at the time of the frame set.
        observations: N detections with their discs.
        single: as in `Estimator`.
    """
    n = len(cameras.names)
    if not len(observations):
        return OffsetInformation.none(n)
    A, g, e = _equations(cameras, states, observations, single)
    body = np.unique(observations.discs.body, return_inverse=True)[1]
    camera = observations.detections.camera
    J = _jacobian(A, np.concatenate([g[:, :, None], _whitened_shifts(observations)], 2), body, camera, n)
    k, weights = J.shape[2] - 3 * n, np.ones(len(e))
    for _ in range(2):  # reweighted once, by the residuals without the offsets
        H, right = _normal_equations(J, e, weights)
        H[np.arange(k), np.arange(k)] += np.tile(WEAK, k // 6)
        prior = np.concatenate([np.zeros(k), np.full(n, 1.0), np.full(2 * n, 1 / SHIFT_PX**2)])
        solution = np.linalg.solve(H + np.diag(prior), right)
        weights = 1 / (1 + np.sum((e - J @ solution) ** 2, 1) / CAUCHY**2)
    by_pose = np.linalg.solve(H[:k, :k], np.column_stack([H[:k, k:], right[:k]]))
    motion = np.sum(g**2, 1) * _variance_px2(observations)
    return OffsetInformation(
        H[k:, k:] - H[k:, :k] @ by_pose[:, :-1],
        right[k:] - H[k:, :k] @ by_pose[:, -1],
        np.bincount(camera, motion, n),
        np.bincount(camera, minlength=n).astype(float),
    )


def disagreement(
    info: OffsetInformation, min_shift_px: float, has_shifts: bool = False
) -> Disagreement | None:
    """The cameras whose offsets differ from those of the largest group; None if none differs.

    A common offset of all cameras is unobservable, so offsets are relative to the group that most cameras share.

    Args:
        info: of some frame sets.
        min_shift_px: RMS image motion that an offset must explain: calibration errors explain less.
        has_shifts: whether images may be shifted too; then offsets are known only where motions differ.
    """
    n = len(info.count)
    M, y = info.with_unknown_shifts() if has_shifts else info.without_shifts()
    known = np.flatnonzero((info.count > 0) & (np.diag(M) > 1.0))
    if len(known) < 2:
        return None
    M, y = M[np.ix_(known, known)], y[known]
    offsets = np.linalg.pinv(M, rcond=1e-6) @ y
    speed_px = np.sqrt(info.motion_px2[known] / info.count[known])
    sigma = np.sqrt(1 / np.diag(M))
    same = 3 * np.hypot(sigma[:, None], sigma) + SAME_S
    agree = np.abs(offsets[:, None] - offsets) < same
    size = agree.sum(1)
    first = int(np.argmax(size))
    group = agree[first]
    offsets, sigma_group = _relative_to(group, M, y)
    significant = (np.abs(offsets) > SIGMAS * np.hypot(sigma, sigma_group)) & (
        np.abs(offsets) * speed_px > min_shift_px
    )
    outliers = significant & ~group
    if not outliers.any():
        return None
    rivals = size[outliers] >= size[first]
    return Disagreement(
        _spread(offsets, known, n),
        _spread(np.hypot(sigma, sigma_group), known, n),
        _spread(outliers | rivals.any(), known, n).astype(bool),
        not rivals.any(),
    )


def _relative_to(group: Mask, M: Array, y: Array) -> tuple[Array, Array]:
    """Offsets (K,) if those of the group are zero, and their standard deviations."""
    out, fixed = np.flatnonzero(~group), np.zeros(len(group))
    if not len(out):
        return np.zeros(len(group)), fixed
    inverse = np.linalg.pinv(M[np.ix_(out, out)], rcond=1e-9)
    solved, sigma = np.zeros(len(group)), np.zeros(len(group))
    solved[out], sigma[out] = inverse @ y[out], np.sqrt(np.maximum(np.diag(inverse), 0))
    return solved, sigma


def _spread(values: Array | Mask, rows: Index, n: int) -> Array:
    spread = np.zeros(n)
    spread[rows] = values
    return spread


def _equations(
    cameras: CameraArray, states: States, observations: MatchedObservations, single: Mask
) -> tuple[Array, Array, Array]:
    """Whitened derivatives by the pose (N, 2, 6) and by the time (N, 2), and residuals (N, 2); zero if not visible."""
    discs, seen = observations.discs, observations.detections
    cov = seen.cov + SLACK_PX**2 * np.eye(2)[:, :, None]
    whiten = MatchedObservations.of_discs(replace(seen, cov=cov), discs).whiten
    poses = cameras.frame_poses(states, seen.exposures)
    rows = poses.linearize_centres(discs.columns, seen.xy, whiten, single)
    spin = np.einsum("nji,nj->ni", states.R, states.omega)[discs.body]  # body frame
    g = np.einsum("nai,ni->na", rows[:, :, THETA], spin)
    g += np.einsum("nai,ni->na", rows[:, :, POSITION], states.v[discs.body])
    return rows[:, :, :6], g, rows[:, :, 12]


def _jacobian(A: Array, by_camera: Array, body: Index, camera: Index, n_cameras: int) -> Array:
    """(N, 2, 6 B + 3 C): poses of B bodies, then the time offsets of C cameras, then their image shifts.

    Args:
        A: (N, 2, 6) by the pose.
        by_camera: (N, 2, 3) by the time offset and the image shift.
        body, camera: (N,).
        n_cameras: C.
    """
    k = 6 * (int(body.max()) + 1)
    J, rows = np.zeros((len(A), 2, k + 3 * n_cameras)), np.arange(len(A))[:, None]
    J[rows, :, 6 * body[:, None] + np.arange(6)] = A.transpose(0, 2, 1)
    shift = k + n_cameras + 2 * camera
    columns = np.stack([k + camera, shift, shift + 1], 1)
    J[rows, :, columns] = by_camera.transpose(0, 2, 1)
    return J


def _whitened_shifts(observations: MatchedObservations) -> Array:
    """(N, 2, 2) whitened derivatives by a shift of the image: L^-1, where L L^T is the covariance."""
    cov = observations.detections.cov + SLACK_PX**2 * np.eye(2)[:, :, None]
    return np.linalg.inv(np.linalg.cholesky(cov.transpose(2, 0, 1)))


def _normal_equations(J: Array, e: Array, weights: Array) -> tuple[Array, Array]:
    flat, root = J.reshape(-1, J.shape[2]), np.repeat(np.sqrt(weights), 2)
    weighted = flat * root[:, None]
    return weighted.T @ weighted, weighted.T @ (e.reshape(-1) * root)


def _variance_px2(observations: MatchedObservations) -> Array:
    """(N,) mean variance of a whitened coordinate, px^2."""
    cov = observations.detections.cov
    return (cov[0, 0] + cov[1, 1]) / 2 + SLACK_PX**2
