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
from fusion.model.observations import MatchedObservations
from fusion.model.states import OMEGA, POSITION, VELOCITY, States

# The errors of a camera by their columns (`calib.rig.camera_errors`).
CAUSES: dict["Cause", slice] = {"pose": slice(0, 6), "clock": slice(6, 7), "focal": slice(7, 8)}
Cause = Literal["pose", "clock", "focal", "wand"]
# Standard deviations of errors that a hypothesis frees: weak, they only keep the system regular. Arrivals show larger
# jumps of a clock.
FREE_SIGMA = np.array([0.3] * 3 + [0.5] * 3 + [0.1, 0.1])
WAND_SIGMA = 0.05  # of the rig's size, if the lengths of the wand are wrong
SHAPE_M = 1e-3  # of a marker's position in robots.yaml, measured by hand
POSE_SIGMA = 1.0, 1.0  # of a robot, rad and m: its keyframe alone determines it
FALSE_ALARM = 1e-6  # probability of a chi-square test that decides
RIVAL = 1e-3  # likelihood of another explanation, relative to the accepted one
LARGE = 2.0  # ratio of errors to those that the rig states, from which it is reported or corrected
CONFIRMED = 3  # judgements in a row, of which one may be by chance
MAX_ITERATIONS, CONVERGED = 20, 1e-4  # relative decrease of the cost
FIRST_DAMPING = 1e-4
BEHIND = 1e6  # squared residual of a disc that is behind its camera
ADEQUATE = 1.5  # ratio of the mean robust cost to that of noise, up to which a model explains the residuals
MIN_FOR_PAIRS = 3  # cameras, of which two that move together look like the third: more are needed for pairs
MAX_SUSPECTS = 4  # cameras that are combined to pairs: those that explain most alone
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
    observations: MatchedObservations
    by_focal: Array
    keyframe: Index

    @property
    def camera(self) -> Index:
        """(N,) of each observation."""
        return self.observations.detections.camera

    @property
    def growth(self) -> Array:
        """(8 C,) errors of the cameras by the logarithm of the rig's size."""
        return errors_of_size(self.T)

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
        discs = replace(seen.discs, body=row[seen.discs.body])
        return replace(
            self,
            states=self.states.select(bodies),
            velocity_sigma=self.velocity_sigma[bodies],
            moving=self.moving[bodies],
            single=self.single[bodies],
            observations=replace(seen, discs=discs),
            by_focal=np.ascontiguousarray(self.by_focal[:, kept]),
            keyframe=self.keyframe[bodies],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """The errors (C, 8) that are free, and where the search for them begins (C, 8); `cameras` are those at fault.

    The standard deviations of all other errors are `scale` times those of the calibration. If `has_other_size`, the
    size of the whole rig is free as well.
    """

    cause: Cause | None
    cameras: tuple[int, ...]
    free: Mask
    start: Array
    scale: float = 1.0
    has_other_size: bool = False

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

    def is_part_of(self, other: "Hypothesis") -> bool:
        """Whether the other one frees all that this one does."""
        is_free = (self.free <= other.free).all() and self.has_other_size <= other.has_other_size
        return bool(is_free) and self.scale in (1.0, other.scale)

    @property
    def n_free(self) -> int:
        """The number of free parameters."""
        return int(self.free.sum()) + self.has_other_size


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A hypothesis after its fit.

    Attributes:
        cost: robust sum of squares, with the priors.
        penalty: of the free parameters (Bayesian information criterion), and of the errors that a scale allows.
        errors: (C, 8) of the cameras, to be applied to `Window.T` by `retract`.
        bodies: (B, 12) errors of the bodies, to be applied to `Window.states`.
        prior: (8 C, 8 C) information about the errors by the calibration, where they are not free.
        reduced: (8 C, 8 C + 1) normal equations of the errors by the observations, robots eliminated.
        rows: (N, 2, 12 + 8 + 1) whitened derivatives of the observations by the errors of their bodies and cameras, and
            residuals.
        squared: (N,) squared whitened residuals; NaN where the disc is not visible.
    """

    hypothesis: Hypothesis
    cost: float
    penalty: float
    errors: Array
    bodies: Array
    prior: Array
    reduced: Array
    rows: Array
    squared: Array

    @property
    def by_camera(self) -> Array:
        """(N, 2, 8) whitened derivatives of the observations by the errors of their cameras."""
        return self.rows[:, :, 12:-1]

    @property
    def equations(self) -> tuple[Array, Array]:
        """Least squares H e = y, (8 C, 8 C) and (8 C,), about the errors by the observations alone."""
        return self._about_errors(self.reduced)

    def _about_errors(self, reduced: Array) -> tuple[Array, Array]:
        H, g = reduced[:, :-1], reduced[:, -1]
        return H / self.variance, (g + H @ self.errors.ravel()) / self.variance

    def equations_of_unknown_shapes(self, window: Window) -> tuple[Array, Array]:
        """The same, if each marker may be `SHAPE_M` off its place on its robot, in all keyframes the same: bodies and
        then markers are eliminated."""
        discs, C = window.observations.discs, ERRORS * len(window.names)
        marker = np.unique(discs.marker, return_inverse=True)[1]
        shapes = slice(C, C + 3 * (int(marker.max(initial=-1)) + 1))
        k, R = np.arange(len(marker))[:, None], window.states.retract(self.bodies).R[discs.body]
        columns = np.zeros((len(marker), 2, shapes.stop + 1))  # of cameras and markers, and residuals
        columns[k, :, ERRORS * window.camera[:, None] + np.arange(ERRORS)] = self.by_camera.transpose(0, 2, 1)
        columns[k, :, C + 3 * marker[:, None] + np.arange(3)] = (self.rows[:, :, POSITION] @ R).transpose(
            0, 2, 1
        )
        columns[:, :, -1] = self.rows[:, :, -1]
        weights, priors = 1 / (1 + np.nan_to_num(self.squared) / _core.CAUCHY**2), _body_prior(window)
        H = np.einsum("n,nai,naj->ij", weights, columns, columns, optimize=True)
        for b, prior in enumerate(priors):
            mine = discs.body == b
            J, rest = self.rows[mine, :, :12].reshape(-1, 12), columns[mine].reshape(-1, columns.shape[2])
            weighted = J.T * np.repeat(weights[mine], 2)
            cross = weighted @ rest
            cross[:, -1] -= prior * self.bodies[b]
            H -= cross.T @ np.linalg.solve(weighted @ J + np.diag(prior), cross)
        known = H[shapes, shapes] + np.eye(shapes.stop - C) / SHAPE_M**2
        H -= H[:, shapes] @ np.linalg.solve(known, H[shapes])
        return self._about_errors(np.delete(H[:C], shapes, axis=1))

    @property
    def variance(self) -> float:
        """Of a whitened residual, by the median, not below 1."""
        return max(1.0, self._median())

    def noise(self) -> float:
        """Variance of a whitened residual, with the parameters counted that took their share of the observations; not
        below 1, infinite if nothing is left."""
        determined = CAUSES["pose"].stop * len(self.bodies) + self.hypothesis.n_free
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

    def growth(self, window: Window) -> float:
        """The logarithm of how much larger the arena is than the rig, by the errors."""
        return float(self.errors.ravel() @ window.growth / (window.growth @ window.growth))

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
    """

    cause: Cause | None
    cameras: tuple[int, ...]
    fit: Fit
    misfit: float = 1.0
    scale: float = 1.0

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
        moved: cameras that are known to have moved: a fault is theirs.
    """
    n = len(window.names)
    none = fit(window, Hypothesis.of(None, (), n))
    if not is_contradicted(none, n, 1.0):
        return Verdict(None, (), none, scale=_most_likely_scale(window, none))
    everything = fit(window, Hypothesis.of(None, range(n), n, starts))
    scale = _most_likely_scale(window, everything)
    if not is_contradicted(none, n, everything.noise()):
        return Verdict(None, (), none, scale=scale)
    if not everything.is_adequate():  # nor is any other hypothesis
        return Verdict(None, tuple(range(n)), everything, none.misfit, scale)
    scaled = fit(window, replace(none.hypothesis, scale=scale))
    return replace(_compare(window, [none, scaled], starts, moved), misfit=none.misfit, scale=scale)


def _compare(window: Window, as_stated: Sequence[Fit], starts: Array, moved: Sequence[int]) -> Verdict:
    n, seeing = len(window.names), np.unique(window.camera).tolist()
    if moved:
        return decide([*as_stated, fit(window, Hypothesis.of("pose", moved, n, starts))], seeing, moved)
    fits = [fit(window, Hypothesis.of(cause, (k,), n, starts)) for cause in CAUSES for k in seeing]
    other_size = replace(as_stated[0].hypothesis, cause="wand", has_other_size=True)
    fits += [fit(window, Hypothesis.of("focal", seeing, n)), fit(window, other_size)]
    if len(seeing) > MIN_FOR_PAIRS:
        suspects = _suspects([f for f in fits if f.hypothesis.cause == "pose"])
        fits += [fit(window, Hypothesis.of("pose", pair, n, starts)) for pair in combinations(suspects, 2)]
    return decide([*as_stated, *fits], seeing)


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


def is_contradicted(none: Fit, n_cameras: int, variance: float) -> bool:
    """Whether errors of the cameras explain more than chance, with those that the prior held back: the score test (Rao
    1948) of all of them together, and how far the prior was stretched. With A the information of the window and x its
    estimate, the sum is x^T (A^-1 + S)^-1 x, chi-square if the errors have the covariance S of the prior.

    Args:
        none: the fit without a fault.
        n_cameras: of the rig.
        variance: of whitened residuals, as of a model that explains all that errors of the cameras can: the residuals
            of `none` contain the fault.
    """
    observed, gradient = none.reduced[:, :-1], none.reduced[:, -1]
    score = gradient @ np.linalg.solve(observed + np.diag(np.tile(FREE_SIGMA**-2, n_cameras)), gradient)
    stretched = none.errors.ravel() @ none.prior @ none.errors.ravel()
    return bool(score + stretched > variance * chdtri(ERRORS * n_cameras, FALSE_ALARM))


def decide(fits: Sequence[Fit], seeing: Sequence[int], moved: Sequence[int] = ()) -> Verdict:
    """Accept the best hypothesis if it beats all others, and if a majority of the cameras `seeing` is not at fault, or
    if these are known to have `moved`.

    Only cameras that see robots count: of three, one that turned looks like the two others that turned together.

    A hypothesis that frees more than the best one is no rival: it contains that one, and its penalty says that it
    explains no more. One camera at fault is more probable than larger errors of all, by `RIVAL`;
    only cameras that can be found at fault refute these.
    """
    variance = min(f.variance for f in fits)
    score = {id(f): f.cost / variance + f.penalty + f.hypothesis.odds for f in fits}
    best = min(fits, key=lambda f: score[id(f)])
    limit = score[id(best)] + chdtri(CAUSES["pose"].stop, FALSE_ALARM)
    rivals = [
        f
        for f in fits
        if not best.hypothesis.is_part_of(f.hypothesis)
        and not f.hypothesis.odds
        and score[id(f)] < limit
        and (not best.hypothesis.odds or 2 * len(f.hypothesis.cameras) < len(seeing))
    ]
    cause, cameras = best.hypothesis.cause, best.hypothesis.cameras
    is_of_few = cause == "focal" or 2 * len(cameras) < len(seeing)
    if not rivals and (is_of_few or cameras == tuple(moved)):
        return Verdict(cause, cameras, best)
    named = {k for f in (best, *rivals) for k in f.hypothesis.cameras}
    return Verdict(None, tuple(seeing if best.hypothesis.odds else sorted(named)), best)


def _suspects(poses: Sequence[Fit]) -> list[int]:
    ranked = sorted(poses, key=lambda f: f.cost)[:MAX_SUSPECTS]
    return sorted(f.hypothesis.cameras[0] for f in ranked)


def fit(window: Window, hypothesis: Hypothesis) -> Fit:
    """Fit cameras and robots from the start of the hypothesis, by Levenberg-Marquardt with Cauchy weights."""
    prior = _prior(window, hypothesis)
    at = _evaluate(window, hypothesis, prior, hypothesis.start, np.zeros((len(window.states), 12)))
    damping = FIRST_DAMPING
    for _ in range(MAX_ITERATIONS):
        by_camera, by_body = _step(window, hypothesis, at, damping)
        tried = _evaluate(window, hypothesis, prior, at.errors + by_camera, at.bodies + by_body)
        if tried.cost >= at.cost:
            damping *= 10
            continue
        is_converged = at.cost - tried.cost < CONVERGED * at.cost
        at, damping = tried, damping / 10
        if is_converged:
            break
    reduced, _ = _eliminate(window, at, 0.0)
    penalty = float(hypothesis.n_free * np.log(2 * len(at.squared)))
    if hypothesis.scale != 1.0:
        stated, larger = (_allowed(window.covariance(s), reduced[:, :-1]) for s in (1.0, hypothesis.scale))
        penalty += np.log(2 * len(at.squared)) + larger - stated
    found = at.errors, at.bodies, at.prior
    return Fit(hypothesis, at.cost, penalty, *found, reduced, at.rows, at.squared)


def _prior(window: Window, hypothesis: Hypothesis) -> Array:
    """(8 C, 8 C) information about the errors, without that about the free ones."""
    held = ~hypothesis.free.ravel()
    covariance = window.covariance(hypothesis.scale) * np.outer(held, held)
    covariance += np.diag((hypothesis.free * FREE_SIGMA**2).ravel())
    if hypothesis.has_other_size:
        covariance += WAND_SIGMA**2 * np.outer(window.growth, window.growth)
    return np.asarray(np.linalg.inv(covariance), float)


def _body_prior(window: Window) -> Array:
    """(B, 12) information about the errors of the bodies."""
    rotation, position = POSE_SIGMA
    weak = np.tile([rotation**-2.0] * 3 + [position**-2.0] * 3 + [0.0] * 6, (len(window.states), 1))
    weak[:, OMEGA] = (window.velocity_sigma[:, 0] ** -2)[:, None]
    weak[:, VELOCITY] = (window.velocity_sigma[:, 1] ** -2)[:, None]
    return weak


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """A point of the search: errors of cameras (C, 8) and bodies (B, 12), and the equations there.

    Attributes:
        prior: (8 C, 8 C) information about the errors of the cameras.
        rows: (N, 2, 12 + 8 + 1) derivatives by body and camera, and residuals.
        squared: (N,) squared residuals; NaN where the disc is not visible.
        cost: robust sum of squares, with the priors.
    """

    errors: Array
    bodies: Array
    prior: Array
    rows: Array
    squared: Array
    cost: float


def _evaluate(window: Window, hypothesis: Hypothesis, prior: Array, errors: Array, bodies: Array) -> _Point:
    """Linearize at a point; `prior` (8 C, 8 C) is the information of the hypothesis."""
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
    columns = replace(discs, frame=discs.frame + len(camera) * ~shows_clock).columns
    poses, whiten = _core.FramePoses(states.bodies, exposures), window.observations.whiten
    by_body = poses.linearize_centres(columns, seen.xy, whiten, window.single)
    by_camera = poses.differentiate_by_camera(columns, whiten, window.by_focal)
    by_camera[:, :, 6] *= shows_clock[:, None]
    visible = (by_camera != 0).any((1, 2))
    r = by_body[:, :, 12] - by_camera[:, :, 7] * errors[window.camera, 7, None]
    squared = np.where(visible, np.sum(r**2, 1), np.nan)
    capped = np.nan_to_num(squared, nan=BEHIND)
    cost = _core.CAUCHY**2 * np.log1p(capped / _core.CAUCHY**2).sum()
    cost += errors.ravel() @ prior @ errors.ravel() + np.sum(bodies**2 * _body_prior(window))
    rows = np.concatenate([by_body[:, :, :12], by_camera, r[:, :, None]], 2)
    return _Point(errors, bodies, prior, rows, squared, float(cost))


def _eliminate(window: Window, at: _Point, damping: float) -> tuple[Array, Array]:
    """See `_core.eliminate_bodies`."""
    weights = 1 / (1 + np.nan_to_num(at.squared) / _core.CAUCHY**2)
    prior, n = _body_prior(window), len(window.names)
    body, camera = window.observations.discs.body, window.camera
    return _core.eliminate_bodies(at.rows, weights, body, camera, prior, -prior * at.bodies, n, damping)


def _step(window: Window, hypothesis: Hypothesis, at: _Point, damping: float) -> tuple[Array, Array]:
    """Steps (C, 8) of the cameras and (B, 12) of the bodies."""
    reduced, by_body = _eliminate(window, at, damping)
    H = reduced[:, :-1] + at.prior
    H[np.diag_indices(len(H))] += damping * np.abs(np.diag(reduced))
    step = np.asarray(np.linalg.solve(H, reduced[:, -1] - at.prior @ at.errors.ravel()), float)
    return step.reshape(-1, ERRORS), by_body[:, :, -1] - by_body[:, :, :-1] @ step
