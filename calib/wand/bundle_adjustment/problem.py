# SPDX-License-Identifier: BSD-3-Clause
"""The data of the wand's bundle adjustment: observations, unknowns (`State`) and constants (`Problem`)."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calib.rig.camera import FLAT, LENS, PER_CAMERA, POSE, span_dimension, with_distortion
from calib.wand.detections import MarkerImages
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import adjoint, invert, rotation_from_vector

# Prior standard deviations: of the pose, and of the time offset (s).
POSE_SIGMA, OFFSET_SIGMA = [np.inf] * 6, [0.5]
READOUT_SIGMA = 0.02  # of the readout time, beside what is given, s: rolling shutters take 5 to 40 ms
# And of the clock's drift, s/s: of a clock that a time service slews, and of a free-running crystal (50 ppm at most).
SLEWED_DRIFT, CRYSTAL_DRIFT = 5e-4, 3e-5
# Of a marker's place in the wand's file, as a share of the wand's size: a millimetre of half a metre.
SHAPE_SIGMA = 0.002
MAX_SHAPED = 32  # markers of a wand whose places are estimated: the errors of more average out
SHAKE_ITERATIONS = 4  # that satisfy several lengths together


@dataclass(frozen=True, slots=True, eq=False)
class WandObservations(MarkerImages):
    """Observed marker centres: `uv` are the discs' own.

    Attributes:
        row: (n,) index of the detection in the labeled recording.
        knot: (n,) index of the frame set, and of its knot.
    """

    row: Index
    knot: Index


@dataclass(frozen=True, slots=True)
class AffineWand:
    """Markers as combinations of basis markers, and the shapes that the wand may have.

    Attributes:
        points: (M, 3) the markers, metres.
        shapes: (n, M, 3) orthonormal displacements of all markers, within the line, plane or space that they span, that
            neither move, nor turn, nor scale the wand.
        basis: (B,) indices of the basis markers: 1, 2 on a line, 3 in a plane or 4.
        weights: (M, B) rows that sum to 1; marker k = weights[k] @ basis points.
        pairs: (E, 2) pairs of basis markers, as indices into `basis`.
        lengths: (E,) their distances, metres.
    """

    points: Array
    shapes: Array
    basis: Index
    weights: Array
    pairs: Index
    lengths: Array

    @classmethod
    def of(cls, wand: Body) -> "AffineWand":
        """Choose the basis greedily: each next marker is the farthest from the span of the previous ones."""
        points = wand.points
        extent = np.ptp(points, axis=0).max()
        basis = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
        while len(basis) < min(4, len(points)):
            off = (points - points[basis[0]]).T
            if len(basis) > 1:
                span = np.linalg.qr((points[basis[1:]] - points[basis[0]]).T)[0]
                off = off - span @ (span.T @ off)
            if (distance := np.linalg.norm(off, axis=0)).max() < FLAT * extent:
                break
            basis.append(int(distance.argmax()))
        return cls._at(points, _shapes(points), np.array(basis))

    @classmethod
    def _at(cls, points: Array, shapes: Array, basis: Index) -> "AffineWand":
        weights = np.vstack([points.T, np.ones(len(points))]).T @ _coordinates(points[basis]).T
        pairs = np.array(list(combinations(range(len(basis)), 2)), np.intp).reshape(-1, 2)
        ends = points[basis][pairs]
        lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
        return cls(points, shapes, basis, weights, pairs, lengths)

    def displaced(self, shape: Array) -> "AffineWand":
        """The wand with its markers displaced by a combination (n,) of its `shapes`."""
        if not shape.any():
            return self
        return self._at(self.points + np.tensordot(shape, self.shapes, 1), self.shapes, self.basis)

    def scaled(self, factor: float) -> "AffineWand":
        """The wand at another size."""
        return self._at(factor * self.points, self.shapes, self.basis)

    def jacobians(self) -> tuple[Array, Array]:
        """Derivatives of the weights (n, M, B) and of the lengths (n, E) by the combination of `shapes`."""
        moved = self.shapes[:, self.basis]
        # Weights w of a marker p in the basis A: A w = (p, 1), so A dw = (dp - dA w, 0).
        by_weights = (self.shapes - self.weights @ moved) @ _coordinates(self.points[self.basis])[:, :3].T
        (first, second), ends = self.pairs.T, self.points[self.basis]
        along = (ends[first] - ends[second]) / self.lengths[:, None]
        return by_weights, ((moved[:, first] - moved[:, second]) * along).sum(axis=2)


def _coordinates(basis: Array) -> Array:
    """(B, 4) the affine coordinates of homogeneous points, in the span of a basis (B, 3)."""
    return np.asarray(np.linalg.pinv(np.vstack([basis.T, np.ones(len(basis))])), float)


def _shapes(points: Array) -> Array:
    """`AffineWand.shapes` of points (M, 3)."""
    count, dimension = len(points), span_dimension(points)
    if not 2 < count <= MAX_SHAPED:
        return np.zeros((0, count, 3))
    off = points - points.mean(axis=0)
    axes = np.linalg.svd(off)[2][:dimension]
    within, units = off @ axes.T, np.eye(dimension)
    turns = [np.outer(a, b) - np.outer(b, a) for a, b in combinations(units, 2)]
    similar = [np.tile(unit, (count, 1)) for unit in units] + [within @ turn for turn in turns] + [within]
    rest = np.linalg.svd(np.reshape(similar, (len(similar), -1)))[2][len(similar) :]
    return np.asarray(rest.reshape(-1, count, dimension) @ axes, float)


@dataclass(frozen=True, slots=True)
class BackgroundPoints:
    """Images of J points at unknown positions, at most one a camera and point, sorted by point, then by camera.

    Attributes:
        point, camera: (n,) numbers, from 0.
        uv: (n, 2) raw pixels.
        cov: (n, 2, 2) their covariance, square pixels.
    """

    point: Index
    camera: Index
    uv: Array
    cov: Array

    def __len__(self) -> int:
        """The number of points."""
        return int(self.point[-1]) + 1 if len(self.point) else 0

    @classmethod
    def none(cls) -> "BackgroundPoints":
        """No points."""
        nothing = np.zeros(0, np.intp)
        return cls(nothing, nothing, np.zeros((0, 2)), np.zeros((0, 2, 2)))

    def select(self, rows: NDArray) -> "BackgroundPoints":
        """The rows (n,) that a mask selects, with the points renumbered."""
        point = np.unique(self.point[rows], return_inverse=True)[1]
        return BackgroundPoints(point, self.camera[rows], self.uv[rows], self.cov[rows])


@dataclass(frozen=True, slots=True)
class State:
    """The unknowns.

    Attributes:
        cameras: (C, 4, 4) T_world_cam.
        clocks: (C, 3) time offset, s, drift, s/s, and readout time beside the given one, s (`true_times`).
        lenses: (C, 9) corrections of the lenses' parameters (`calib.rig.camera.LENS`).
        motion: (K, 2, B, 3) positions and velocities of the wand's basis markers at the knots, world.
        shape: (n,) displacement of the wand's markers from their places in its file, metres (`AffineWand.shapes`).
        points: (J, 3) positions of the background points, world.
    """

    cameras: Array
    clocks: Array
    lenses: Array
    motion: Array
    shape: Array
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def of(cls, cameras: Array, offset_s: Array, motion: Array, shapes: int = 0) -> "State":
        """The state with these cameras, time offsets and motion; no drift, no correction of the lenses, and the wand
        as in its file, which has a number of `shapes`."""
        clocks = np.column_stack([offset_s, np.zeros((len(cameras), 2))])
        return cls(cameras, clocks, np.zeros((len(cameras), len(LENS))), motion, np.zeros(shapes))

    def retract(self, camera_step: Array, motion_step: Array, shape_step: Array) -> "State":
        """Add a step: (C, 18) of the cameras, rotation and translation in their own frames, (K, 6 B) of the motion, and
        (n,) of the wand's shape. Points follow from the cameras (`eliminated_points`)."""
        cameras = self.cameras.copy()
        for T, xi in zip(cameras, camera_step, strict=True):
            T[:3, 3] += T[:3, :3] @ xi[3:6]
            T[:3, :3] = T[:3, :3] @ rotation_from_vector(xi[:3])
        clocks, lenses = self.clocks + camera_step[:, 6:9], self.lenses + camera_step[:, 9:]
        motion = self.motion + motion_step.reshape(self.motion.shape)
        return State(cameras, clocks, lenses, motion, self.shape + shape_step, self.points)

    def scaled(self, factor: float) -> "State":
        """The state at another scale of the world."""
        cameras = self.cameras.copy()
        cameras[:, :3, 3] *= factor
        lengths = {name: factor * getattr(self, name) for name in ("motion", "shape", "points")}
        return replace(self, cameras=cameras, **lengths)

    def true_times(self, observations: MarkerImages, middle_s: float) -> Array:
        """(n,) true capture times: stamp + offset + drift (stamp - `middle_s`) + readout time x height in the image."""
        offset, drift, readout = self.clocks[observations.camera].T
        t_s = observations.t_s
        return t_s + offset + drift * (t_s - middle_s) + readout * observations.image_row

    def lens(self, camera: int, lens: Lens) -> Lens:
        """The given lens of a camera with this state's correction."""
        change = self.lenses[camera]
        if not change.any():
            return lens
        scale, ratio = change[0], change[4]
        parameters = with_distortion(lens).parameters
        parameters[:2] *= np.exp([scale + ratio / 2, scale - ratio / 2])
        parameters[2:5] += change[1:4]
        higher = parameters[5:9]  # a fisheye has three
        higher += change[5 : 5 + len(higher)]
        return lens.with_parameters(parameters)

    def corrected(self, lenses: Sequence[Lens]) -> list[Lens]:
        """The given lenses of all cameras with this state's corrections."""
        return [self.lens(k, lens) for k, lens in enumerate(lenses)]


@dataclass(frozen=True, slots=True)
class Problem:
    """The constants of an adjustment.

    Attributes:
        lenses: given lenses of the C cameras.
        wand: as in its file.
        knot_s: (K,) ascending, K >= 2.
        gap_s: longest interval between knots over which the motion prior holds.
        density: power spectral density of the wand's acceleration, m^2/s^3.
        middle_s: stamp at which time offsets are defined.
        lens_sigma: (C, 9) prior standard deviations of the lenses' parameters in the estimate.
        readout_s: (C,) given readout times, which the stamps of observations contain.
        free: indices of the camera parameters that are estimated (`calib.rig.camera`).
        fixed_distance: two cameras and their distance, where no wand length fixes the scale.
        estimated: cameras that are estimated, the others are fixed; None for all.
        covariance_lens_sigma: (C, 9) prior standard deviations for the covariance; `lens_sigma` if None.
        estimates_shape: whether the wand's shape is estimated.
        drift_sigma: prior standard deviation of the clocks' drift, s/s.
        background: images of the background points.
    """

    lenses: list[Lens]
    wand: AffineWand
    knot_s: Array
    gap_s: float
    density: float
    middle_s: float
    lens_sigma: Array
    readout_s: Array
    free: tuple[int, ...] = POSE
    fixed_distance: tuple[int, int, float] | None = None
    estimated: tuple[int, ...] | None = None
    covariance_lens_sigma: Array | None = None
    estimates_shape: bool = True
    drift_sigma: float = SLEWED_DRIFT
    background: BackgroundPoints = field(default_factory=BackgroundPoints.none)

    def prior_sigma(self, of_covariance: bool = False) -> Array:
        """(C, d) prior standard deviations of the free parameters in the estimate, or for the covariance; infinite for
        poses."""
        given = self.covariance_lens_sigma if of_covariance else None
        clocks = [*OFFSET_SIGMA, self.drift_sigma, READOUT_SIGMA]
        others = np.tile(POSE_SIGMA + clocks, (len(self.lenses), 1))
        lenses = self.lens_sigma if given is None else given
        return np.concatenate([others, lenses], axis=1)[:, self.free]

    def estimated_cameras(self) -> tuple[int, ...]:
        """Indices of the S cameras that are estimated."""
        return tuple(range(len(self.lenses))) if self.estimated is None else self.estimated

    @property
    def shapes(self) -> int:
        """The number of estimated parameters of the wand's shape; none without an estimated camera."""
        return len(self.wand.shapes) if self.estimates_shape and self.estimated != () else 0

    def shape_sigma(self) -> float:
        """Prior standard deviation of the wand's shape, metres."""
        return SHAPE_SIGMA * float(self.wand.lengths.max(initial=0.0))

    def estimated_rows(self) -> Index:
        """(S d,) the free parameters of the estimated cameras among those (C d,) of all."""
        d = len(self.free)
        return np.ravel(np.array(self.estimated_cameras(), np.intp)[:, None] * d + np.arange(d))

    def global_rows(self) -> Index:
        """(S d + n,) those parameters of the cameras and of the wand's shape that are estimated, of all (C d + n,)."""
        cameras = len(self.lenses) * len(self.free)
        return np.append(self.estimated_rows(), cameras + np.arange(self.shapes))

    def with_free(self, *parameters: tuple[int, ...]) -> "Problem":
        """The problem with these groups of camera parameters free."""
        return replace(self, free=tuple(sorted(sum(parameters, ()))))

    def retract(self, state: State, camera_step: Array, motion_step: Array, shape_step: Array) -> State:
        """Add a step along the curve on which lengths change as along the tangent.

        In a straight step, a rotation would lengthen a stiff wand, and a translation the distance that fixes the
        scale, by the square of the step.
        """
        trial = state.retract(camera_step, motion_step, shape_step)
        return self._restore_scale(replace(trial, motion=self._restore_lengths(state.motion, trial.motion)))

    def _restore_lengths(self, before: Array, after: Array) -> Array:
        """The motion `after` a step, with the lengths of the basis that the step has to first order (SHAKE: Ryckaert
        et al. 1977)."""
        after = after.copy()
        ends, moved = before[:, 0][:, self.wand.pairs], after[:, 0][:, self.wand.pairs]
        gap, step = ends[:, :, 0] - ends[:, :, 1], moved[:, :, 0] - moved[:, :, 1]
        length = np.linalg.norm(gap, axis=2)
        wanted = np.maximum((gap * step).sum(axis=2) / length, length / 2)
        for _ in range(SHAKE_ITERATIONS if len(self.wand.pairs) > 1 else 1):
            for e, (i, j) in enumerate(self.wand.pairs):
                gap = after[:, 0, i] - after[:, 0, j]
                excess = (1 - wanted[:, e, None] / np.linalg.norm(gap, axis=1, keepdims=True)) / 2 * gap
                after[:, 0, i] -= excess
                after[:, 0, j] += excess
        return after

    def _restore_scale(self, state: State) -> State:
        """The state scaled to the fixed distance, if there is one: observations do not depend on the scale."""
        if self.fixed_distance is None:
            return state
        a, b, distance = self.fixed_distance
        return state.scaled(
            distance / float(np.linalg.norm(state.cameras[a, :3, 3] - state.cameras[b, :3, 3]))
        )


@dataclass(frozen=True, slots=True)
class Estimate:
    """A problem with its observations, and the current estimate of its unknowns."""

    problem: Problem
    state: State
    observations: WandObservations

    def select(self, rows: Mask) -> "Estimate | None":
        """The estimate with some of its n observations, `rows` (n,), and with the knots where two cameras or more have
        one of these; None where these are fewer than two."""
        knot, count = self.observations.knot, len(self.problem.knot_s)
        pairs = np.unique(np.column_stack([knot, self.observations.camera])[rows], axis=0)
        known = np.bincount(pairs[:, 0], minlength=count) >= 2
        if known.sum() < 2:
            return None
        rows = rows & known[knot]
        observations = self.observations.select(rows)
        return Estimate(
            replace(self.problem, knot_s=self.problem.knot_s[known]),
            replace(self.state, motion=self.state.motion[known]),
            replace(observations, knot=(np.cumsum(known) - 1)[knot[rows]]),
        )


@dataclass(frozen=True, slots=True)
class Adjusted:
    """The optimal state, and what its covariance follows from (`covariance`).

    Attributes:
        problem: that was optimized.
        state: cameras, clocks, lenses and motion.
        used: (n,) observations that were not rejected.
        residuals: (n, 2) observed minus predicted pixels, of all observations.
        scale: ratio of the residuals to their assumed standard deviations, the square root of the variance factor.
        information: (S d, S d) of the S estimated cameras' free parameters at the assumed noise, with priors. Its null
            space is the gauge: the choice of the world, and of the time that clocks are relative to.
        shape_covariance: (n, n) of the wand's shape, at the assumed noise; (0, 0) where it is fixed.
        scores: (L + J, S d) gradients by interval between knots, then by background point, without priors.
        background_used: images of background points that were not rejected.
        converged: whether the motion could be profiled out: it can't where the cameras contradict each other.
        inflation: factor of the covariance for residuals that are correlated in time.
    """

    problem: Problem
    state: State
    used: Mask
    residuals: Array
    scale: float
    information: Array
    shape_covariance: Array
    scores: Array
    background_used: Mask
    converged: bool
    inflation: float = 1.0

    def scaled(self, factor: float) -> "Adjusted":
        """The adjustment with the wand, and so the world, at another size."""
        problem, translations = self.problem, np.isin(self.problem.free, POSE[3:])
        by = np.tile(np.where(translations, 1 / factor, 1.0), len(problem.estimated_cameras()))
        return replace(
            self,
            problem=replace(problem, wand=problem.wand.scaled(factor), density=factor**2 * problem.density),
            state=self.state.scaled(factor),
            information=by[:, None] * self.information * by,
            shape_covariance=factor**2 * self.shape_covariance,
            scores=by * self.scores,
        )


def gauge_directions(state: State, free: tuple[int, ...]) -> Array:
    """(C d, g) changes of the free camera parameters that no observation depends on: rotation and translation of the
    world, and offset and drift that all clocks share."""
    columns = np.zeros((len(state.cameras), PER_CAMERA, 8))
    for T, rows in zip(state.cameras, columns, strict=True):
        rows[:6, :6] = adjoint(invert(T))
        rows[6, 6] = rows[7, 7] = 1.0
    present = [g for g in range(8) if g < 6 or g in free]
    return columns[:, free][:, :, present].reshape(-1, len(present))


def scale_direction(problem: Problem, state: State) -> Array:
    """(C d,) change of the free camera parameters by the relative size of the world, without its component along the
    gauge."""
    by_scale, cameras = np.zeros((len(state.cameras), PER_CAMERA)), state.cameras
    by_scale[:, POSE[3:]] = np.einsum("cji,cj->ci", cameras[:, :3, :3], cameras[:, :3, 3])
    change = by_scale[:, problem.free].ravel()
    gauge = np.linalg.qr(gauge_directions(state, problem.free))[0]
    return np.asarray(change - gauge @ (gauge.T @ change), float)


def invert_information(problem: Problem, state: State, information: Array) -> Array:
    """(S d, S d) pseudo-inverse of the information on the estimated cameras, without the gauge."""
    if problem.estimated is not None:
        return np.asarray(np.linalg.inv(information), float)
    gauge = gauge_directions(state, problem.free)
    rest = np.linalg.svd(gauge)[0][:, gauge.shape[1] :]
    return np.asarray(rest @ np.linalg.inv(rest.T @ information @ rest) @ rest.T, float)
