# SPDX-License-Identifier: BSD-3-Clause
"""Continuous calibration: how far the poses and lenses of cameras are from those in use (Kalman filters).

Every robot is a wand: each window of keyframes that contradicts no camera shows the errors of all of them. Poses walk
at random, because mounts turn and shift. At what rate is unknown too: there is a filter for each rate, and windows show
which is the most likely. Lenses wander about the calibrated ones, as far as a lens is stable. A window that contradicts
what is known shows that one camera changed, if that explains it better than a change of any other.
docs/design/rig_graph.md has the equations.
"""

from collections.abc import Collection, Mapping, Sequence

import msgspec
import numpy as np
from scipy.special import chdtri

from calib.rig.camera import Camera
from calib.rig.camera_errors import (
    ERRORS,
    OF_IMAGE,
    USUAL_PX,
    error_covariance,
    errors_of_motion,
    image_metrics,
    own_blocks,
    usual_covariance,
    with_errors,
    working_ranges,
)
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.pose import Pose
from fusion.model.corrections import RigRefinement
from fusion.rig_graph.clock_walk import OFFSET_SIGMA_S
from fusion.rig_graph.hypotheses import (
    CAUSES,
    CONFIRMED,
    FALSE_ALARM,
    FREE_SIGMA,
    LARGE,
    MIN_FOR_PAIRS,
    RIVAL,
    retract,
)
from fusion.rig_graph.keyframes import GATES_PX

# In which lenses wander as far as they are stable, and windows count for the rates of mounts.
MEMORY_S = 60.0
FIRST_S = 1.0  # before the first window: mounts walked, so that no pose is exact
# By which the rotation of a camera is another one after a minute, rad: from a mount that windows can't tell from one at
# rest, to one that turns by half a degree in an hour, and more if it goes on in one direction.
RATES = np.array([3e-5, 1e-4, 3e-4, 1e-3]) / 60**0.5
ARM_M = 1.0  # from a camera to the point about which its mount turns: the foot of a tripod, the end of a bar
OF_MOUNT = np.array(
    [1.0] * 3 + [ARM_M] * 3 + [0.0] * 2
)  # how far each error of a camera walks, by its rotation


class Refinement:
    """The errors of C cameras as they are in use.

    Args:
        cameras: by name.
        since: (8 C,) variances of what clocks and lenses change after the calibration.

    Attributes:
        cameras: as they are in use.
        relative: (8 C, 8 C) takes from errors what is common to all cameras: the motion of their frame.
    """

    def __init__(self, cameras: Mapping[str, Camera], since: Array) -> None:
        self.cameras, given = cameras, list(cameras.values())
        self._metrics = image_metrics(given)
        self._stated, self._since, self._scale = error_covariance(given), np.diag(since), 1.0
        self._own = _own_covariance(given, self._metrics)
        self._together = errors_of_motion(np.array([camera.matrix() for camera in given]))
        self.relative = _relative_to_all(self._together, self._metrics)
        self._of_mounts = np.tile(OF_MOUNT, len(given))
        self._is_of_lens = np.tile(OF_IMAGE & (OF_MOUNT == 0), len(given))
        self._corrected = np.zeros(len(since))  # of poses, and of lenses that are the calibrated ones
        self._t_ns, self._n_windows = 0, 0.0  # that count
        self._forget()

    def _forget(self) -> None:
        """Windows showed nothing: of each rate, estimates, covariances and the logarithm of its likelihood."""
        self._n_refused = 0
        self._freed = set[int]()  # cameras that changed, and are not corrected yet
        self._other_lenses = set[int]()  # the same of lenses
        self._x = np.zeros((len(RATES), len(self._since)))
        self._P = np.tile(self._prior, (len(RATES), 1, 1))
        self._evidence = np.zeros(len(RATES))

    @property
    def x(self) -> Array:
        """(8 C,) the estimate of the errors, by the most likely rate."""
        return self._x[np.argmax(self._evidence)]

    @property
    def P(self) -> Array:
        """(8 C, 8 C) its covariance."""
        return self._P[np.argmax(self._evidence)]

    @property
    def _prior(self) -> Array:
        return self._scale**2 * self._stated + self._since

    def widen(self, scale: float) -> None:
        """The errors are larger than the rig states by a factor."""
        if scale > self._scale:
            self._P += (scale**2 - self._scale**2) * self._stated
            self._scale = scale

    def free_lenses(self, cameras: Sequence[int]) -> None:
        """The focal length of a camera is another one, or those of several are, in common."""
        together = np.zeros(len(self.x))
        together[ERRORS * np.array(cameras) + CAUSES["focal"].start] = FREE_SIGMA[CAUSES["focal"]][0]
        self._P += np.outer(together, together)
        self._other_lenses.update(cameras)

    def _free(self, k: int) -> None:
        """The pose or the lens of a camera is another one."""
        rows = ERRORS * k + np.flatnonzero(OF_IMAGE)
        self._P[(..., *np.ix_(rows, rows))] += (GATES_PX[-1] / USUAL_PX) ** 2 * self._own[np.ix_(rows, rows)]
        self._freed.add(k)
        self._other_lenses.add(k)

    def update(self, t_ns: int, H: Array, y: Array, offsets: Array, of_clocks: Array) -> None:
        """Add keyframes.

        Args:
            t_ns: their mean time.
            H, y: (8 C, 8 C) and (8 C,) least squares H e = y about the errors.
            offsets, of_clocks: (C,) of the clocks, and their covariance (C, C): what is left of them looks like poses,
                and is the same in all windows, so it counts as many times.
        """
        self._wander(max(0, t_ns - self._t_ns) * 1e-9 if self._t_ns else FIRST_S)
        self._t_ns, identity, clocks = t_ns, np.eye(len(y)), np.flatnonzero(~np.tile(OF_IMAGE, len(offsets)))
        own = self._own.copy()
        own[np.ix_(clocks, clocks)] += self._n_windows * of_clocks
        with_own = np.linalg.inv(identity + H @ own)
        H, y = with_own @ H, with_own @ (y - H[:, clocks] @ offsets)
        if not self._agrees(H, y - H @ self.x):
            self._n_refused += 1
            if self._n_refused >= CONFIRMED:
                self._forget()
            return
        self._n_refused = 0
        self._add(H, y)

    def _add(self, H: Array, y: Array) -> None:
        """The update of each filter, by factors of its covariance: errors of clocks and of poses differ by magnitudes.
        A rate is as likely as its filter predicted the window."""
        L = np.linalg.cholesky(self._P)
        with_window = np.eye(len(y)) + L.transpose(0, 2, 1) @ H @ L
        self._P = L @ np.linalg.solve(with_window, L.transpose(0, 2, 1))
        off = y - self._x @ H.T
        step = np.einsum("kij,kj->ki", self._P, off)
        explained = self._x @ y + np.sum(off * (self._x + step), axis=1)
        self._evidence += (explained - np.linalg.slogdet(with_window)[1]) / 2
        self._x = self._x + step

    def _wander(self, dt: float) -> None:
        """Poses walk at random; lenses are an Ornstein-Uhlenbeck process about the calibrated ones, and clocks about
        those in use."""
        decay = np.exp(-dt / MEMORY_S)
        self._n_windows = 1 + decay**2 * self._n_windows
        decays = np.where(self._of_mounts > 0, 1.0, decay)
        walked = dt * np.square(np.outer(RATES, self._of_mounts))
        widened = walked + (1 - decays**2) * np.diag(self._prior)
        calibrated = -self._corrected * self._is_of_lens
        self._x = calibrated + decays * (self._x - calibrated)
        self._P = np.outer(decays, decays) * self._P + widened[:, :, None] * np.eye(len(decays))
        self._evidence *= decay

    def _agrees(self, H: Array, off: Array) -> bool:
        """Whether a window agrees with what is known, or shows which camera changed: its pose and its lens are free
        from then on, since robots at one place do not distinguish them.

        Of three cameras, two that moved together look like the third; a clock is that of `ClockWalk`.

        Args:
            H: (8 C, 8 C) information of the window about the errors.
            off: (8 C,) H times the difference between the errors that it shows and the estimate.
        """
        n = len(off) // ERRORS
        with_window = np.eye(len(off)) + H @ self.P
        information = np.asarray(np.linalg.solve(with_window, H), float)
        score = np.asarray(np.linalg.solve(with_window, off), float)
        gains = {
            (k, cause): _gain(score, information, ERRORS * k + np.arange(ERRORS)[rows], FREE_SIGMA[rows])
            for k in range(n)
            for cause, rows in CAUSES.items()
        }
        (camera, cause), gain = max(gains.items(), key=lambda item: item[1])
        if gain < chdtri(2, FALSE_ALARM):
            cost = off @ np.linalg.solve(H + np.diag(np.tile(FREE_SIGMA**-2, n)), score)
            return bool(cost < chdtri(len(off), FALSE_ALARM))
        rival = max(g for (k, other), g in gains.items() if k != camera or "clock" in (cause, other))
        n_seeing = np.count_nonzero(np.diag(H)[::ERRORS])
        if n_seeing <= MIN_FOR_PAIRS or gain - rival < chdtri(2, RIVAL):
            return False
        self._free(camera)
        return True

    @property
    def off_px(self) -> Array:
        """(C,) what the estimated errors displace in the images, RMS of a coordinate, beside what all have in common:
        robots do not show that."""
        x = self.relative @ self.x
        return self._image_px(np.outer(x, x))

    @property
    def _sigma_px(self) -> Array:
        """(C,) standard deviations of what `off_px` estimates."""
        return self._image_px(self.relative @ self.P @ self.relative.T)

    @property
    def is_significant(self) -> bool:
        """Whether a camera is off by more than windows have of their own and is uncertain yet, as each camera that
        changed is, and none so far that its markers were mistaken."""
        off_px = self.off_px
        is_known = off_px > LARGE * self._sigma_px
        is_off = (is_known & (off_px > LARGE * USUAL_PX)).any()
        return bool(is_off and (off_px < GATES_PX[-1]).all() and is_known[sorted(self._freed)].all())

    @property
    def excess(self) -> float:
        """By how much errors may be larger than the rig states where a camera is off but not known yet; 1 else."""
        off_px = self.off_px
        ratios = np.hypot(off_px, self._sigma_px) / np.maximum(self._image_px(self._stated), USUAL_PX)
        return max(1.0, float(ratios[off_px > LARGE * USUAL_PX].max(initial=1.0)))

    def _image_px(self, covariance: Array) -> Array:
        return np.sqrt(np.einsum("kij,kij->k", own_blocks(covariance), self._metrics))

    def correct(self, pinned: Collection[str]) -> RigRefinement:
        """Correct all cameras that are not pinned by their estimated errors, which count from the corrected poses on. A
        lens is as it was where its error is negligible."""
        errors = self.x.reshape(-1, ERRORS) * OF_IMAGE
        errors[[name in pinned for name in self.cameras]] = 0.0
        errors[np.sqrt(self._metrics[:, 7, 7]) * np.abs(errors[:, 7]) < USUAL_PX, 7] = 0.0
        self._x, self._corrected = self._x - errors.ravel(), self._corrected + errors.ravel()
        self._corrected.reshape(-1, ERRORS)[sorted(self._other_lenses), CAUSES["focal"]] = 0.0
        joint, clocks = self.P + self._own + np.outer(self.x, self.x), ~np.tile(OF_IMAGE, len(errors))
        joint += self._in_common()
        joint[clocks], joint[:, clocks] = self._stated[clocks], self._stated[:, clocks]
        self._stated, self._scale = joint, 1.0
        self._freed.clear()
        self._other_lenses.clear()
        pairs = zip(self.cameras.items(), errors, strict=True)
        self.cameras = with_errors({name: _displaced(camera, e) for (name, camera), e in pairs}, joint)
        off_px = self._image_px(np.outer(errors, errors))
        worst = int(np.argmax(off_px))
        name, of_worst = list(self.cameras)[worst], tuple(errors[worst].tolist())
        return RigRefinement(self.cameras, name, float(off_px[worst]), of_worst)

    def _in_common(self) -> Array:
        """(8 C, 8 C) covariance of the motion since the calibration that all cameras have in common, which robots do
        not show: mounts moved independently, by a variance that their motions relative to each other show."""
        poses = self._of_mounts > 0
        A = self._together[poses] / self._of_mounts[poses, None]
        moved = self._corrected[poses] / self._of_mounts[poses]
        relative = moved - A @ np.linalg.lstsq(A, moved, rcond=None)[0]
        variance = relative @ relative / max(1, len(moved) - A.shape[1])
        return variance * self._together @ np.linalg.pinv(A.T @ A, hermitian=True) @ self._together.T


def _displaced(camera: Camera, errors: Array) -> Camera:
    """The camera with another pose and focal length, by its errors (8,)."""
    if not errors.any():
        return camera
    T, scale = retract(camera.matrix()[None], errors[None])[0], float(np.exp(errors[7]))
    fx, fy = (camera.fx * scale, camera.fy * scale) if errors[7] else (camera.fx, camera.fy)
    return msgspec.structs.replace(camera, T_world_cam=Pose.from_matrix(T), fx=fx, fy=fy, covariance=None)


def _gain(score: Array, information: Array, rows: Index, sigma: Array) -> float:
    """Twice the logarithm by which free errors make a window more likely.

    Args:
        score: (8 C,) derivative of the logarithm of the likelihood by the errors.
        information: (8 C, 8 C) of the window and of the estimate about a change of the errors.
        rows, sigma: (n,) of the free errors, and their standard deviations.
    """
    A, b = np.eye(len(rows)) + sigma[:, None] * information[np.ix_(rows, rows)] * sigma, sigma * score[rows]
    return float(b @ np.linalg.solve(A, b) - np.linalg.slogdet(A)[1])


def _relative_to_all(together: Array, metrics: Array) -> Array:
    """(8 C, 8 C) that takes from errors of the cameras the motion that explains most of the images of all of them, of
    those that all have in `together` (8 C, 6): that of the common frame."""
    weighted = (metrics @ together.reshape(len(metrics), ERRORS, -1)).reshape(together.shape)
    motion = np.linalg.pinv(weighted.T @ together, hermitian=True) @ weighted.T
    return np.eye(len(together)) - together @ motion


def _own_covariance(cameras: Sequence[Camera], metrics: Array) -> Array:
    """(8 C, 8 C) of the errors that each window has of its own, because those of lenses vary with the places of robots:
    `USUAL_PX` in the image by the pose, as much by the focal length, and those of the clocks."""
    joint = np.zeros((len(cameras), ERRORS, len(cameras), ERRORS))
    for k, (camera, range_m) in enumerate(zip(cameras, working_ranges(cameras).tolist(), strict=True)):
        joint[k, :6, k, :6] = usual_covariance(camera, range_m)
        joint[k, 6, k, 6] = OFFSET_SIGMA_S**2
        joint[k, 7, k, 7] = USUAL_PX**2 / metrics[k, 7, 7]
    return joint.reshape((len(cameras) * ERRORS,) * 2)
