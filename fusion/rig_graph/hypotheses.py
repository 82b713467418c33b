# SPDX-License-Identifier: BSD-3-Clause
"""Which camera is at fault? A generalized likelihood ratio over hypotheses about the cameras.

Robots and cameras of some keyframes are one least-squares problem (Triggs et al. 2000). A hypothesis frees some errors
of some cameras: the pose, the clock offset, the focal length. All other errors keep the prior of the calibration. The
robots are eliminated body by body (Schur complement); observations have Cauchy weights. The hypothesis with the lowest
cost is accepted only if it beats every other one by the margin that chi-square asks (Basseville and Nikiforov 1993,
section 2.4.2), each with a penalty for its free parameters (Schwarz 1978). Otherwise the data do not decide.

docs/design/rig_graph.md derives the equations.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from scipy.special import chdtri, exp1

from calib.rig.camera_errors import ERRORS, errors_of_size
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.pose import rotation_from_vector
from fusion import _core
from fusion.model.marker_places import PLACE_M
from fusion.model.observations import MatchedObservations
from fusion.model.states import OMEGA, POSITION, VELOCITY, States

# The errors of a camera by their columns (`calib.rig.camera_errors`).
CAUSES: dict["Cause", slice] = {"pose": slice(0, 6), "clock": slice(6, 7), "focal": slice(7, 8)}
Cause = Literal["pose", "clock", "focal", "wand", "shape"]
# Standard deviations of errors that a hypothesis frees: weak, they only keep the system regular. Arrivals show larger
# jumps of a clock.
FREE_SIGMA = np.array([0.3] * 3 + [0.5] * 3 + [0.1, 0.1])
# Of what all cameras have in common: the rig's size, if the lengths of the wand are wrong, and their focal lengths,
# which a temperature changes together.
COMMON_SIGMA: dict["Common", float] = {"size": 0.05, "focal": 0.1}
Common = Literal["size", "focal"]
FREE_SHAPE_M = 0.02  # of a marker's place that was measured or drawn wrong
POSE_SIGMA = 1.0, 1.0  # of a robot, rad and m: its keyframe alone determines it
FALSE_ALARM = 1e-6  # probability of a chi-square test that decides
RIVAL = 1e-3  # likelihood of another explanation, relative to the accepted one
LARGE = 2.0  # ratio of errors to those that the rig states, from which it is reported or corrected
INTERVAL_NS = 90_000_000  # between keyframes: a tenth of a second, at 30 frame sets a second too
CONFIRMED = 3  # judgements in a row, of which one may be by chance
MAX_ITERATIONS, CONVERGED = 20, 1e-4  # relative decrease of the cost
FIRST_DAMPING = 1e-4
BEHIND = 1e6  # squared residual of a disc that is behind its camera
ADEQUATE = 1.5  # ratio of the mean robust cost to that of noise, up to which a model explains the residuals
MIN_FOR_PAIRS = 3  # cameras, of which two that move together look like the third: more are needed for pairs
MAX_PAIRS = 6  # that are fitted: those that explain most by one linear system
MAX_SUSPECTS = 4  # robots whose shapes are tried one by one: those whose markers seem farthest off
SCALES = 2.0 ** np.arange(0, 12, 0.25)  # of the errors that the calibration states


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Keyframes as one problem of C cameras and B bodies: each robot in each keyframe is a body of its own.

    Attributes:
        names: (C,) of the cameras.
        T: (C, 4, 4) their calibrated poses T_world_cam.
        prior: (8 C, 8 C) covariance of the errors of the cameras by the calibration.
        since: (8 C,) variances of what changed since then: clocks and lenses.
        states: B bodies, with velocities that do not depend on single frames.
        velocity_sigma: (B, 2) of these: angular and linear, rad/s and m/s.
        moving: (B,) whether that is more than noise. The others show no clock: if noise is their velocity, a clock that
            is off by a second explains anything.
        single: (B,) bodies with one marker.
        robot: (B,) of each body.
        markers, owner: (M,) rows of the marker table, and the robots that have them, in ascending order.
        observations: N detections of all keyframes with their discs.
        by_focal: (2, N) derivatives of the undistorted detections by the logarithm of the focal length.
        keyframe: (B,) of each body.
    """

    names: tuple[str, ...]
    T: Array
    prior: Array
    since: Array
    states: States
    velocity_sigma: Array
    moving: Mask
    single: Mask
    robot: Index
    markers: Index
    owner: Index
    observations: MatchedObservations
    by_focal: Array
    keyframe: Index

    @property
    def camera(self) -> Index:
        """(N,) of each observation."""
        return self.observations.detections.camera

    @property
    def stamp_variance(self) -> Array:
        """(N,) variance of each observation's time by errors of single stamps, s^2. The n detections of a frame have a
        common error: each counts n times the variance, so that the frame shows its camera's clock no better."""
        frame, sigma = self.observations.discs.frame, self.observations.detections.exposures.stamp_sigma
        return sigma[frame] ** 2 * np.bincount(frame, minlength=1)[frame]

    @property
    def marker(self) -> Index:
        """(N,) of each observation, of the M markers."""
        return np.searchsorted(self.markers, self.observations.discs.marker)

    def common(self, of: Common) -> Array:
        """(8 C,) errors of the cameras by the logarithm of the rig's size, or of all focal lengths."""
        if of == "size":
            return errors_of_size(self.T)
        return np.tile(np.arange(ERRORS) == CAUSES["focal"].start, len(self.names)).astype(float)

    def covariance(self, scale: float) -> Array:
        """(8 C, 8 C) of the errors of the cameras, if those of the calibration are larger than it states."""
        return scale**2 * self.prior + np.diag(self.since)

    def select(self, keyframes: Mask) -> "Window":
        """The window of some of the keyframes."""
        bodies = np.flatnonzero(keyframes[self.keyframe])
        row = np.full(len(self.keyframe), -1)
        row[bodies] = np.arange(len(bodies))
        kept = np.flatnonzero(row[self.observations.discs.body] >= 0)
        seen = self.observations.select(kept)
        return replace(
            self,
            states=self.states.select(bodies),
            velocity_sigma=self.velocity_sigma[bodies],
            moving=self.moving[bodies],
            single=self.single[bodies],
            robot=self.robot[bodies],
            observations=seen.with_bodies(row[seen.discs.body]),
            by_focal=np.ascontiguousarray(self.by_focal[:, kept]),
            keyframe=self.keyframe[bodies],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """The errors (C, 8) that are free, and where the search for them begins (C, 8); `cameras` are those at fault.

    The standard deviations of all other errors are `scale` times those of the calibration. What all cameras have in
    `common` is free as well, and the places of the markers of `robots`.
    """

    cause: Cause | None
    cameras: tuple[int, ...]
    free: Mask
    start: Array
    scale: float = 1.0
    common: Common | None = None
    robots: tuple[int, ...] = ()

    @classmethod
    def of(
        cls, cause: Cause | None, cameras: Sequence[int], n_cameras: int, start: Array | None = None
    ) -> "Hypothesis":
        """Errors of one cause in some cameras; without a cause, none or all errors of these cameras."""
        free = np.zeros((n_cameras, ERRORS), bool)
        free[list(cameras), CAUSES[cause] if cause else slice(0, ERRORS)] = True
        begin = np.zeros((n_cameras, ERRORS)) if start is None else np.where(free, start, 0.0)
        return cls(cause, tuple(cameras), free, begin)

    @property
    def odds(self) -> float:
        """Twice the logarithm of how much less probable errors of all cameras are than one camera at fault."""
        return float(chdtri(2, RIVAL)) if self.scale != 1.0 else 0.0

    @property
    def margin(self) -> float:
        """By how much it must be better than another one: chi-square of what is free, six parameters at most."""
        n = int(self.free.sum()) + (self.common is not None)
        is_of_few = n > 0 and self.scale == 1.0 and not self.robots
        return float(chdtri(min(n, CAUSES["pose"].stop) if is_of_few else CAUSES["pose"].stop, FALSE_ALARM))

    def is_part_of(self, other: "Hypothesis") -> bool:
        """Whether the other one frees all that this one does."""
        is_free = (self.free <= other.free).all() and self.common in (None, other.common)
        return bool(is_free) and self.scale in (1.0, other.scale) and set(self.robots) <= set(other.robots)

    def n_free(self, window: Window) -> int:
        """The number of free parameters."""
        n_places = 3 * int(
            np.isin(window.owner, self.robots).sum()
        )  # of which a pose of each robot is not determined
        return (
            int(self.free.sum())
            + (self.common is not None)
            + n_places
            - CAUSES["pose"].stop * len(self.robots)
        )


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A hypothesis after its fit.

    Attributes:
        cost: robust sum of squares, with the priors.
        penalty: of the free parameters (Bayesian information criterion), and of the errors that a scale allows.
        errors: (C, 8) of the cameras, to be applied to `Window.T` by `retract`.
        bodies: (B, 12) errors of the bodies, to be applied to `Window.states`.
        places: (M, 3) errors of the places of markers on their robots, metres (body frame).
        prior: (8 C, 8 C) information about the errors by the calibration, where they are not free.
        reduced: (8 C, 8 C + 1) normal equations of the errors by the observations, robots and the places of their
            markers eliminated.
        by_marker, of_places: how the places follow the cameras, and the information about them; see
            `_core.eliminate_robots`.
        rows: (N, 2, 12 + 8 + 3 + 1) whitened derivatives of the observations by the errors of their bodies, cameras and
            places, and residuals.
        squared: (N,) squared whitened residuals; NaN where the disc is not visible.
        size: logarithm of how much larger the arena is than the rig, by the errors.
    """

    hypothesis: Hypothesis
    cost: float
    penalty: float
    errors: Array
    bodies: Array
    places: Array
    prior: Array
    reduced: Array
    by_marker: Array
    of_places: Array
    rows: Array
    squared: Array
    size: float = 0.0

    @property
    def by_camera(self) -> Array:
        """(N, 2, 8) whitened derivatives of the observations by the errors of their cameras."""
        return self.rows[:, :, 12 : 12 + ERRORS]

    @property
    def equations(self) -> tuple[Array, Array]:
        """Least squares H e = y, (8 C, 8 C) and (8 C,), about the errors by the observations alone."""
        H, g = self.reduced[:, :-1], self.reduced[:, -1]
        return H / self.variance, (g + H @ self.errors.ravel()) / self.variance

    def equations_of_places(self, markers: Index) -> tuple[Array, Array]:
        """Least squares H p = y, (3 m, 3 m) and (3 m,), about the places of `markers` (m,) of one robot, which are
        free, by the observations and what the hypothesis has of the cameras: all else is eliminated."""
        rows = (3 * markers[:, None] + np.arange(3)).ravel()
        given_cameras = self.by_marker[markers].reshape(len(rows), -1)
        by_cameras, step = given_cameras[:, :-1], given_cameras[:, -1]
        given = self.of_places[np.ix_(rows, rows)]
        cross, cameras = given @ by_cameras, self.reduced[:, :-1] + self.prior
        H = given - cross @ np.linalg.solve(cameras + by_cameras.T @ cross, cross.T)
        of_cameras = np.linalg.solve(cameras, self.reduced[:, -1] - self.prior @ self.errors.ravel())
        y = H @ (self.places[markers].ravel() + step - by_cameras @ of_cameras)
        return (H - np.eye(len(H)) / FREE_SHAPE_M**2) / self.variance, y / self.variance

    @property
    def variance(self) -> float:
        """Of a whitened residual, by the median, not below 1."""
        return max(1.0, self._median())

    def noise(self, window: Window) -> float:
        """Variance of a whitened residual, with the parameters counted that took their share of the observations; not
        below 1, infinite if nothing is left."""
        determined = CAUSES["pose"].stop * len(self.bodies) + self.hypothesis.n_free(window)
        left = 1 - determined / (2 * max(1, int(np.isfinite(self.squared).sum())))
        return max(1.0, self._median() / left) if left > 0 else np.inf

    def _median(self) -> float:
        """Variance of a whitened residual by the median; 0 without any."""
        known = self.squared[np.isfinite(self.squared)]
        return float(np.median(known) / chdtri(2, 0.5)) if len(known) else 0.0

    @property
    def misfit(self) -> float:
        """Mean squared residual in units of its expectation, not below 1."""
        known = self.squared[np.isfinite(self.squared)]
        return max(1.0, float(known.mean()) / 2) if len(known) else 1.0

    def is_adequate(self) -> bool:
        """Whether the residuals are noise of any variance: a wrong model leaves more large ones."""
        variance = float(np.median(np.nan_to_num(self.squared, nan=BEHIND)) / chdtri(2, 0.5))
        rate = _core.CAUCHY**2 / (2 * max(1.0, variance))
        expected = np.exp(rate) * exp1(
            rate
        )  # of log(1 + square): squares of noise are exponentially distributed
        return bool(self._robust().mean() < ADEQUATE * expected)

    def _robust(self) -> Array:
        """(N,) robust costs, in units of `CAUCHY`^2."""
        return np.log1p(np.nan_to_num(self.squared, nan=BEHIND) / _core.CAUCHY**2)

    def by_keyframe(self, window: Window) -> Array:
        """(K,) mean robust cost of an observation in each keyframe; NaN without any."""
        keyframe = window.keyframe[window.observations.discs.body]
        count = np.bincount(keyframe, minlength=int(window.keyframe.max()) + 1)
        return np.bincount(keyframe, self._robust(), len(count)) / np.where(count, count, np.nan)

    def covariance(self, camera: int) -> Array:
        """(8, 8) of the errors of a camera."""
        rows = slice(ERRORS * camera, ERRORS * (camera + 1))
        return self.variance * self._posterior()[rows, rows]

    def _posterior(self) -> Array:
        """(8 C, 8 C) covariance of the errors, with residuals of unit variance."""
        return np.asarray(np.linalg.inv(self.reduced[:, :-1] + self.prior), float)

    def joint_covariance(self, before: Array, camera: int) -> Array:
        """(8 C, 8 C) of the errors once the pose of one camera is that of this fit, and the others are as they were.

        The error of the new pose is that of the fit, so it is correlated with those of the other cameras as in the
        fit; these keep their own covariance.

        Args:
            before: (8 C, 8 C) that of the calibration.
            camera: whose pose is free in this fit.
        """
        fitted, joint = self._posterior(), before.copy()
        pose = ERRORS * camera + np.arange(CAUSES["pose"].stop)
        others = np.setdiff1d(np.flatnonzero(np.arange(len(joint)) % ERRORS < CAUSES["pose"].stop), pose)
        own, cross = self.variance * fitted[np.ix_(pose, pose)], fitted[np.ix_(pose, others)]
        shared = cross @ np.linalg.pinv(before[np.ix_(others, others)], hermitian=True) @ cross.T
        if np.linalg.eigvalsh(own - shared)[0] < 0:  # the fit's prior is wider than the calibration
            own = own + shared
        joint[pose], joint[:, pose] = 0.0, 0.0
        joint[np.ix_(pose, pose)] = own
        joint[np.ix_(pose, others)], joint[np.ix_(others, pose)] = cross, cross.T
        return joint


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What a window shows.

    Attributes:
        cause: of the accepted hypothesis; None if there is no fault or the data do not decide.
        cameras: at fault; if the data do not decide, those that contradict each other; empty without a fault.
        fit: of the best hypothesis.
        misfit: mean squared residual without a fault in units of its expectation, not below 1.
        scale: of the errors that the calibration states, if no single camera is at fault: the most likely one.
        size: logarithm of how much larger the arena may be than the rig.
        is_pose_known: False if another camera may be at fault as well, so that the fit shows no pose of this one.
    """

    cause: Cause | None
    cameras: tuple[int, ...]
    fit: Fit
    misfit: float = 1.0
    scale: float = 1.0
    size: float = 0.0
    is_pose_known: bool = True

    @property
    def is_of_size(self) -> bool:
        """Whether the rig has another size than the robots; which of them is wrong, one robot does not show."""
        return self.cause == "wand" or (self.fit.hypothesis.cause == "shape" and self.size != 0.0)

    @property
    def is_of_rig(self) -> bool:
        """Whether the errors of all cameras are larger than stated, and no single camera explains that."""
        return not self.cameras and self.fit.hypothesis.scale > 1.0


def retract(T: Array, errors: Array) -> Array:
    """Poses (C, 4, 4) displaced by errors (C, 8)."""
    moved = T.copy()
    moved[:, :3, 3] += np.einsum("cij,cj->ci", T[:, :3, :3], errors[:, 3:6])
    moved[:, :3, :3] = T[:, :3, :3] @ rotation_from_vector(errors[:, :3])
    return moved


def judge(window: Window, starts: Array, moved: Sequence[int] = ()) -> Verdict:
    """Compare the hypotheses.

    Args:
        window: the keyframes.
        starts: (C, 8) errors that explain the images of each camera if only this one is at fault.
        moved: cameras that are known to have moved: a fault is theirs, and perhaps of one more.
    """
    n = len(window.names)
    none = fit(window, Hypothesis.of(None, (), n))
    in_common = np.stack([sigma * window.common(of) for of, sigma in COMMON_SIGMA.items()], axis=1)
    if not is_contradicted(none, in_common, 1.0):
        return Verdict(None, (), none, scale=_most_likely_scale(window, none))
    everything = fit(
        window, replace(Hypothesis.of(None, range(n), n, starts), robots=several_markers(window))
    )
    scale = _most_likely_scale(window, everything)
    if not is_contradicted(none, in_common, everything.noise(window)):
        return Verdict(None, (), none, scale=scale)
    if not everything.is_adequate():  # nor is any other hypothesis, and free errors may be of metres
        return Verdict(None, tuple(range(n)), everything, none.misfit, _most_likely_scale(window, none))
    scaled = fit(window, replace(none.hypothesis, scale=scale))
    return replace(
        _compare(window, [none, scaled], everything, starts, moved), misfit=none.misfit, scale=scale
    )


def _compare(
    window: Window, as_stated: Sequence[Fit], everything: Fit, starts: Array, moved: Sequence[int]
) -> Verdict:
    n, seeing = len(window.names), np.unique(window.camera).tolist()
    if moved:
        more = [sorted({*moved, k}) for k in seeing if k not in moved]  # as the other one on its bar
        poses = [fit(window, Hypothesis.of("pose", cameras, n, starts)) for cameras in (moved, *more)]
        return decide([*as_stated, *poses], seeing, moved)
    fits = [fit(window, Hypothesis.of(cause, (k,), n, starts)) for cause in CAUSES for k in seeing]
    none = as_stated[0].hypothesis
    fits.append(fit(window, replace(none, cause="focal", cameras=tuple(seeing), common="focal")))
    fits.append(fit(window, replace(none, cause="wand", common="size")))
    all_shapes = fit(window, replace(none, cause="shape", robots=several_markers(window)))
    suspected = _displaced_most(window, all_shapes)
    fits += [all_shapes, *(fit(window, replace(all_shapes.hypothesis, robots=(r,))) for r in suspected)]
    if len(seeing) > MIN_FOR_PAIRS:
        likely = _likely_pairs(window, everything, seeing)
        fits += [fit(window, Hypothesis.of("pose", pair, n, starts)) for pair in likely]
    return decide([*as_stated, *fits], seeing)


def several_markers(window: Window) -> tuple[int, ...]:
    """The robots with several markers: the place of a lone one is that of its robot."""
    return tuple(np.unique(window.robot[~window.single]).tolist())


def _displaced_most(window: Window, shapes: Fit) -> list[int]:
    """The robots whose markers a fit places farthest from their places."""
    squared = np.bincount(window.owner, np.sum(shapes.places**2, axis=1))
    return sorted(several_markers(window), key=lambda r: -squared[r])[:MAX_SUSPECTS]


def _most_likely_scale(window: Window, best: Fit) -> float:
    """By how much all errors of all cameras are larger than the calibration states: the best of `SCALES` by the
    marginal likelihood (MacKay 1992), robots and cameras integrated out. With S the covariance of the errors, A the
    information of the window about them and b = A x at its maximum,
    log L = (b^T (A + S^-1)^-1 b - log det(I + S A)) / 2.

    Args:
        window: the keyframes.
        best: a fit that explains them, where A and b are linearized.
    """
    A, b = best.equations

    def gain(scale: float) -> float:
        S = window.covariance(scale)
        return float(b @ S @ np.linalg.solve(np.eye(len(S)) + A @ S, b)) - _allowed(S, A)

    return float(max(SCALES, key=gain))


def _allowed(S: Array, A: Array) -> float:
    """How much errors of covariance S allow a fit to observations with information A about them: log det(I + S A)."""
    return float(np.linalg.slogdet(np.eye(len(S)) + S @ A)[1])


def explained(P: Array, H: Array, y: Array, G: Array, sigma: float) -> tuple[Array, Array]:
    """(K,) how much less keyframes cost if errors are free along one of the columns of G (8 C, K) alone, with a
    standard deviation `sigma`, and (K,) the errors along it; P (8 C, 8 C), H and y as of `_FreedErrors`."""
    score, information = _FreedErrors(P, H, y).along(G)
    information = np.diag(information) + sigma**-2
    return score**2 / information, score / information


def most_explained(window: Window, none: Fit) -> float:
    """By how much less a window costs, in units of what chance allows (`RIVAL`), if errors of one cause are free in one
    camera, or in all that have it in common: the most of all of them, by one linear system at the start of a fit."""
    freed, cameras = _FreedErrors(window.covariance(1.0), *none.equations), _columns(window)
    free = [(cameras[:, k, of], FREE_SIGMA[of]) for k in range(len(window.names)) for of in CAUSES.values()]
    free += [(window.common(of)[:, None], np.array([sigma])) for of, sigma in COMMON_SIGMA.items()]
    return max(freed.gain(G, sigma) / float(chdtri(len(sigma), RIVAL)) for G, sigma in free)


def _columns(window: Window) -> Array:
    """(8 C, C, 8) the errors of the cameras, one column for each error of each camera."""
    n = len(window.names)
    return np.eye(ERRORS * n).reshape(-1, n, ERRORS)


class _FreedErrors:
    """What errors of the cameras explain of keyframes that show H e = y, beside those of the covariance P (8 C, 8 C)
    that the calibration states: a change of it of low rank."""

    def __init__(self, P: Array, H: Array, y: Array) -> None:
        self._with_stated = np.linalg.solve(np.eye(len(y)) + H @ P, np.column_stack([y, H]))

    def along(self, G: Array) -> tuple[Array, Array]:
        """(K,) score and (K, K) information of errors along the columns of G (8 C, K)."""
        return G.T @ self._with_stated[:, 0], G.T @ self._with_stated[:, 1:] @ G

    def gain(self, G: Array, sigma: Array) -> float:
        """By how much less the keyframes cost if errors along the columns of G (8 C, K) are free together, with these
        standard deviations (K,)."""
        score, information = self.along(G)
        return float(score @ np.linalg.solve(information + np.diag(sigma**-2), score))


def is_contradicted(none: Fit, in_common: Array, variance: float) -> bool:
    """Whether errors of the cameras explain more than chance, with those that the prior held back: the score test (Rao
    1948) of all of them together, and how far the prior was stretched. With A the information of the window and x its
    estimate, the sum is x^T (A^-1 + S)^-1 x, chi-square if the errors have the covariance S of the prior. What all
    cameras have in common is one parameter, and hides among so many: it has a test of its own.

    Args:
        none: the fit without a fault.
        in_common: (8 C, K) errors of all cameras by K parameters that all have in common, in their standard deviations.
        variance: of whitened residuals, as of a model that explains all that errors of the cameras can: the residuals
            of `none` contain the fault.
    """
    score = _score(none.reduced)
    stretched = none.errors.ravel() @ none.prior @ none.errors.ravel()
    if score + stretched > variance * chdtri(none.errors.size, FALSE_ALARM):
        return True
    H, g = none.reduced[:, :-1] / variance, none.reduced[:, -1] / variance
    stated = np.asarray(np.linalg.inv(none.prior), float)
    gains, _ = explained(stated, H, g + H @ none.errors.ravel(), in_common, 1.0)
    return bool(gains.max() > chdtri(1, FALSE_ALARM))


def has_changed(window: Window, found: Fit, keyframes: Mask) -> bool:
    """Whether some keyframes (K,) alone show other errors of the cameras than all of them: the score test (Rao 1948)
    of the errors by these, where a fit to all has its minimum."""
    reduced = _reduced_by(window, found, keyframes)
    return bool(_score(reduced) > found.variance * chdtri(len(reduced), FALSE_ALARM))


def equations_by(window: Window, found: Fit, keyframes: Mask) -> tuple[Array, Array]:
    """Least squares as of `Fit.equations` by some keyframes (K,) of a fit to all."""
    return replace(found, reduced=_reduced_by(window, found, keyframes)).equations


def _reduced_by(window: Window, found: Fit, keyframes: Mask) -> Array:
    """Normal equations (8 C, 8 C + 1) by some keyframes (K,), where a fit to all has its minimum."""
    shown, bodies = window.select(keyframes), keyframes[window.keyframe]
    mine = bodies[window.observations.discs.body]
    at = _Point(found.errors, found.bodies[bodies], found.places, found.rows[mine], found.squared[mine], 0.0)
    return _eliminate(shown, _Priors.of(shown, found.hypothesis), at, 0.0)[0]


def _score(reduced: Array) -> float:
    """How much less the squares would be with other errors, by normal equations (8 C, 8 C + 1)."""
    observed, gradient = reduced[:, :-1], reduced[:, -1]
    free = np.diag(np.tile(FREE_SIGMA**-2, len(reduced) // ERRORS))
    return float(gradient @ np.linalg.solve(observed + free, gradient))


def decide(fits: Sequence[Fit], seeing: Sequence[int], moved: Sequence[int] = ()) -> Verdict:
    """Accept the best hypothesis if it beats all others, and if a majority of the cameras `seeing` is not at fault, or
    if these are known to have `moved`.

    Only cameras that see robots count: of three, one that turned looks like the two others that turned together.

    A hypothesis that frees more than the best one is no rival: it contains that one, and its penalty says that it
    explains no more. Where all explanations have a camera in common, that one moved, whichever is true. One camera at
    fault is more probable than larger errors of all, by `RIVAL`; only cameras that can be found at fault refute these.
    """
    variance = min(f.variance for f in fits)
    score = {id(f): f.cost / variance + f.penalty + f.hypothesis.odds for f in fits}
    best = min(fits, key=lambda f: score[id(f)])
    limit = score[id(best)] + best.hypothesis.margin
    rivals = [
        f
        for f in fits
        if not best.hypothesis.is_part_of(f.hypothesis)
        and not f.hypothesis.odds
        and score[id(f)] < limit
        and (not best.hypothesis.odds or 2 * len(f.hypothesis.cameras) < len(seeing))
    ]
    explanations = best, *rivals
    size = next((f.size for f in explanations if f.hypothesis.common == "size"), 0.0)
    cause, cameras = best.hypothesis.cause, best.hypothesis.cameras
    is_of_few = cause == "focal" or 2 * len(cameras) < len(seeing)
    if not rivals and (is_of_few or cameras == tuple(moved)):
        return Verdict(cause, cameras, best, size=size)
    shared = set.intersection(*({*f.hypothesis.cameras} for f in explanations))
    if all(f.hypothesis.cause == "pose" for f in explanations) and len(shared) == 1 and len(seeing) > 2:
        return Verdict("pose", tuple(shared), best, is_pose_known=False)
    named = {k for f in explanations for k in f.hypothesis.cameras}
    return Verdict(None, tuple(seeing if best.hypothesis.odds else sorted(named)), best, size=size)


def _likely_pairs(window: Window, everything: Fit, seeing: Sequence[int]) -> list[tuple[int, int]]:
    """The pairs of cameras that explain most if the poses of both are free, by the equations of a fit of all errors."""
    freed = _FreedErrors(window.covariance(1.0), *everything.equations)
    poses, sigma = _columns(window)[:, :, CAUSES["pose"]], np.tile(FREE_SIGMA[CAUSES["pose"]], 2)

    def gain(pair: tuple[int, int]) -> float:
        return freed.gain(np.hstack([poses[:, k] for k in pair]), sigma)

    return sorted(combinations(seeing, 2), key=gain)[-MAX_PAIRS:]


def fit(window: Window, hypothesis: Hypothesis, max_iterations: int = MAX_ITERATIONS) -> Fit:
    """Fit cameras and robots from the start of the hypothesis, by Levenberg-Marquardt with Cauchy weights; without an
    iteration, the equations are those at the start."""
    priors = _Priors.of(window, hypothesis)
    bodies, places = np.zeros((len(window.states), 12)), np.zeros((len(window.markers), 3))
    at = _evaluate(window, priors, hypothesis.start, bodies, places)
    damping = FIRST_DAMPING
    for _ in range(max_iterations):
        by_camera, by_body, by_place = _step(window, priors, at, damping)
        tried = _evaluate(window, priors, at.errors + by_camera, at.bodies + by_body, at.places + by_place)
        if tried.cost >= at.cost:
            damping *= 10
            continue
        is_converged = at.cost - tried.cost < CONVERGED * at.cost
        at, damping = tried, damping / 10
        if is_converged:
            break
    reduced, _, by_marker, of_places = _eliminate(window, priors, at, 0.0)
    penalty = float(hypothesis.n_free(window) * np.log(2 * len(at.squared)))
    if hypothesis.scale != 1.0:
        stated, larger = (_allowed(window.covariance(s), reduced[:, :-1]) for s in (1.0, hypothesis.scale))
        penalty += np.log(2 * len(at.squared)) + larger - stated
    found = at.errors, at.bodies, at.places, priors.cameras
    growth = window.common("size")
    size = float(at.errors.ravel() @ growth / (growth @ growth))
    reduced_to = reduced, by_marker, of_places
    return Fit(hypothesis, at.cost, penalty, *found, *reduced_to, at.rows, at.squared, size)


@dataclass(frozen=True, slots=True, eq=False)
class _Priors:
    """Information about the errors of cameras (8 C, 8 C), bodies (B, 12) and places of markers (M, 3)."""

    cameras: Array
    bodies: Array
    places: Array

    @classmethod
    def of(cls, window: Window, hypothesis: Hypothesis) -> "_Priors":
        """Without that about the errors that are free."""
        held = ~hypothesis.free.ravel()
        covariance = window.covariance(hypothesis.scale) * np.outer(held, held)
        covariance += np.diag((hypothesis.free * FREE_SIGMA**2).ravel())
        if hypothesis.common is not None:
            of_all = COMMON_SIGMA[hypothesis.common] * window.common(hypothesis.common)
            covariance += np.outer(of_all, of_all)
        rotation, position = POSE_SIGMA
        bodies = np.tile([rotation**-2.0] * 3 + [position**-2.0] * 3 + [0.0] * 6, (len(window.states), 1))
        bodies[:, OMEGA] = (window.velocity_sigma[:, 0] ** -2)[:, None]
        bodies[:, VELOCITY] = (window.velocity_sigma[:, 1] ** -2)[:, None]
        place_m = np.where(np.isin(window.owner, hypothesis.robots), FREE_SHAPE_M, PLACE_M)
        return cls(
            np.asarray(np.linalg.inv(covariance), float), bodies, np.repeat(place_m[:, None] ** -2, 3, axis=1)
        )

    def cost(self, errors: Array, bodies: Array, places: Array) -> float:
        """The sum of squares of errors in their standard deviations."""
        of_robots = np.sum(bodies**2 * self.bodies) + np.sum(places**2 * self.places)
        return float(errors.ravel() @ self.cameras @ errors.ravel() + of_robots)


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """A point of the search: errors of cameras (C, 8), bodies (B, 12) and places (M, 3), and the equations there.

    Attributes:
        rows: (N, 2, 12 + 8 + 3 + 1) derivatives by body, camera and place, and residuals.
        squared: (N,) squared residuals; NaN where the disc is not visible.
        cost: robust sum of squares, with the priors.
    """

    errors: Array
    bodies: Array
    places: Array
    rows: Array
    squared: Array
    cost: float


def _evaluate(window: Window, priors: _Priors, errors: Array, bodies: Array, places: Array) -> _Point:
    """Linearize at a point."""
    states, seen = window.states.retract(bodies), window.observations.detections
    T, camera, discs = retract(window.T, errors), seen.exposures.camera, window.observations.discs
    R, centres = T[camera, :3, :3].transpose(0, 2, 1), T[camera, :3, 3]
    shows_clock, tau = window.moving[discs.body], seen.exposures.tau
    exposures = _core.CameraExposures(  # with the errors of clocks, and then without these
        np.tile(R, (2, 1, 1)),
        np.tile(centres, (2, 1)),
        np.concatenate([tau + errors[camera, 6], tau]),
        np.zeros(2 * len(camera)),
    )
    displaced = replace(
        discs,
        frame=discs.frame + len(camera) * ~shows_clock,
        position=discs.position + places[window.marker].T,
    )
    poses, whiten = _core.FramePoses(states.bodies, exposures), window.observations.whiten
    by_body = poses.linearize_centres(displaced.columns, seen.xy, whiten, window.single)
    by_camera = poses.differentiate_by_camera(displaced.columns, whiten, window.by_focal)
    by_camera[:, :, 6] *= shows_clock[:, None]
    by_place = by_body[:, :, POSITION] @ states.R[discs.body]
    visible = (by_camera != 0).any((1, 2))
    r = by_body[:, :, 12] - by_camera[:, :, 7] * errors[window.camera, 7, None]
    rows = np.concatenate([by_body[:, :, :12], by_camera, by_place, r[:, :, None]], 2)
    rows = with_errors_of_stamps(rows, by_camera[:, :, CAUSES["clock"].start], window.stamp_variance)
    squared = np.where(visible, np.sum(rows[:, :, -1] ** 2, 1), np.nan)
    capped = np.nan_to_num(squared, nan=BEHIND)
    cost = float(_core.CAUCHY**2 * np.log1p(capped / _core.CAUCHY**2).sum())
    return _Point(errors, bodies, places, rows, squared, cost + priors.cost(errors, bodies, places))


def with_errors_of_stamps(rows: Array, velocity: Array, variance: Array) -> Array:
    """Whitened rows (N, 2, K) of equations with the noise of stamps as well: (I + s^2 u u^T)^(-1/2) times the rows, of
    image velocities u (N, 2) and variances s^2 (N,)."""
    squared = np.sum(velocity**2, axis=1)
    some = np.flatnonzero(variance * squared > 0)
    u, along = velocity[some], squared[some]
    less = (1 / np.sqrt(1 + variance[some] * along) - 1) / along
    rows[some] += less[:, None, None] * u[:, :, None] * np.einsum("na,nak->nk", u, rows[some])[:, None]
    return rows


def _eliminate(
    window: Window, priors: _Priors, at: _Point, damping: float
) -> tuple[Array, Array, Array, Array]:
    """See `_core.eliminate_robots`."""
    weights = 1 / (1 + np.nan_to_num(at.squared) / _core.CAUCHY**2)
    of_rows = window.observations.discs.body, window.camera, window.marker
    of_robots = priors.bodies, -priors.bodies * at.bodies, priors.places, -priors.places * at.places
    rest = window.robot, window.owner, *of_robots, len(window.names), damping
    return _core.eliminate_robots(at.rows, weights, *of_rows, *rest)


def _step(window: Window, priors: _Priors, at: _Point, damping: float) -> tuple[Array, Array, Array]:
    """Steps (C, 8) of the cameras, (B, 12) of the bodies and (M, 3) of the places."""
    reduced, by_body, by_place, _ = _eliminate(window, priors, at, damping)
    H = reduced[:, :-1] + priors.cameras
    H[np.diag_indices(len(H))] += damping * np.abs(np.diag(reduced))
    step = np.asarray(np.linalg.solve(H, reduced[:, -1] - priors.cameras @ at.errors.ravel()), float)
    of_bodies, of_places = (by[:, :, -1] - by[:, :, :-1] @ step for by in (by_body, by_place))
    return step.reshape(-1, ERRORS), of_bodies, of_places
