# SPDX-License-Identifier: BSD-3-Clause
"""What a wand's bundle adjustment is about: observations, unknowns, and what stays the same."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.rig.camera import PER_CAMERA, POSE, SHAPE, with_distortion
from calib.wand.trajectory import AffineWand
from camera_node.arrays import Array, Index
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import adjoint, invert, rotation_from_vector

SHAKES = 4  # rounds in which lengths that depend on each other are set
SHAPE_SIGMA = [0.02, 0.3, 0.02, 0.02]
POSE_SIGMA, OFFSET_SIGMA = [np.inf] * 6, [0.5]  # before anything is seen
SLEWED, CRYSTAL = 5e-4, 3e-5  # s/s by which clocks drift: while they are set, and left alone (50 ppm at most)


@dataclass(frozen=True, slots=True)
class WandObservations:
    """Marker centres, one row each.

    Attributes:
        camera: (n,) index of the camera.
        knot: (n,) the instant they belong to.
        label: (n,) marker of the wand.
        t_s, stamp_sigma_s: (n,) stamp, seconds, and what it is off by beside its camera's clock.
        uv: (n, 2) raw pixels, where the disc's own centre is seen.
        cov: (n, 2, 2) covariance of `uv`.
        axes_px, angle_rad: (n, 2) full axes and (n,) direction of the ellipse; NaN where not known.
    """

    camera: Index
    knot: Index
    label: Index
    t_s: Array
    stamp_sigma_s: Array
    uv: Array
    cov: Array
    axes_px: Array
    angle_rad: Array

    def __len__(self) -> int:
        return len(self.uv)

    def select(self, rows: NDArray) -> "WandObservations":
        """The rows that a mask or an index array names."""
        return WandObservations(*(getattr(self, name)[rows] for name in self.__slots__))


@dataclass(frozen=True, slots=True)
class State:
    """The unknowns.

    Attributes:
        cameras: (C, 4, 4) T_world_cam.
        clocks: (C, 2) time offset, s, and drift, s/s: true time = stamp + offset + drift (stamp - middle).
        lenses: (C, 4) log of the focal lengths' factor, and what is added to cx, cy and k1.
        motion: (K, 2, B, 3) positions and velocities of the wand's basis markers at the knots.
    """

    cameras: Array
    clocks: Array
    lenses: Array
    motion: Array

    @classmethod
    def of(cls, cameras: Array, offset_s: Array, motion: Array) -> "State":
        """Cameras and motion, clocks without drift, lenses as they are given."""
        clocks = np.column_stack([offset_s, np.zeros(len(cameras))])
        return cls(cameras, clocks, np.zeros((len(cameras), 4)), motion)

    def moved(self, by: Array, along: Array) -> "State":
        """Cameras changed by `by` (C, 12), turned and shifted in their own frames, the motion by `along` (K, 6 B)."""
        cameras = self.cameras.copy()
        for T, xi in zip(cameras, by, strict=True):
            T[:3, 3] += T[:3, :3] @ xi[3:6]
            T[:3, :3] = T[:3, :3] @ rotation_from_vector(xi[:3])
        clocks, lenses = self.clocks + by[:, 6:8], self.lenses + by[:, 8:12]
        return State(cameras, clocks, lenses, self.motion + along.reshape(self.motion.shape))

    def lens(self, camera: int, lens: Lens) -> Lens:
        """The camera's lens, as adjusted."""
        scale, cx, cy, k1 = self.lenses[camera].tolist()
        if not any((scale, cx, cy, k1)):
            return lens
        parameters = with_distortion(lens).parameters
        parameters[:2] *= np.exp(scale)
        parameters[2:5] += cx, cy, k1
        return lens.with_parameters(parameters)


@dataclass(frozen=True, slots=True)
class Problem:
    """What stays the same from iteration to iteration.

    Attributes:
        lenses: of the C cameras.
        wand: in affine coordinates.
        knot_s: (K,) ascending, K >= 2.
        gap_s: knots further apart say nothing of each other.
        density: power spectral density of the wand's acceleration, m^2/s^3.
        middle_s: the stamp to which time offsets refer.
        lens_sigma: (C, 4) standard deviations that hold log f, cx, cy and k1 to what was given.
        free: which of a camera's 12 parameters are sought.
        fixed_distance: two cameras and their distance, where no wand length carries the scale.
        sought: the cameras that are sought; the others stand where they stand. All, unless given.
        lens_doubt: (C, 4) what covariances take these four to be off by, `lens_sigma` unless given.
        drift_sigma: standard deviation of the clocks' drift before anything is seen, s/s.
    """

    lenses: list[Lens]
    wand: AffineWand
    knot_s: Array
    gap_s: float
    density: float
    middle_s: float
    lens_sigma: Array
    free: tuple[int, ...] = POSE
    fixed_distance: tuple[int, int, float] | None = None
    sought: tuple[int, ...] | None = None
    lens_doubt: Array | None = None
    drift_sigma: float = SLEWED

    def prior_sigma(self) -> Array:
        """(C, d) what holds the free parameters before anything is seen; infinite for poses."""
        return self._before(self.lens_sigma)

    def doubt(self) -> Array:
        """(C, d) what covariances take the free parameters to be off by before anything is seen."""
        return self._before(self.lens_sigma if self.lens_doubt is None else self.lens_doubt)

    def _before(self, lenses: Array) -> Array:
        rest = np.tile(POSE_SIGMA + OFFSET_SIGMA + [self.drift_sigma], (len(self.lenses), 1))
        shapes = np.tile(SHAPE_SIGMA, (len(self.lenses), 1))
        return np.concatenate([rest, lenses, shapes], axis=1)[:, self.free]

    def cameras(self) -> tuple[int, ...]:
        """The cameras that are sought."""
        return tuple(range(len(self.lenses))) if self.sought is None else self.sought

    def moved(self, state: State, by: Array, along: Array) -> State:
        """`State.moved` along the curve on which lengths change as they do along the tangent (a retraction): a turn
        would lengthen a stiff wand, and a shift the distance that carries the scale, by the square of the step."""
        trial = state.moved(by, along)
        return self._to_scale(replace(trial, motion=self._unstretched(state.motion, trial.motion)))

    def _unstretched(self, before: Array, after: Array) -> Array:
        """The motion with the basis's lengths that its step has to first order (SHAKE: Ryckaert et al. 1977)."""
        after = after.copy()
        ends, moved = before[:, 0][:, self.wand.pairs], after[:, 0][:, self.wand.pairs]
        gap, step = ends[:, :, 0] - ends[:, :, 1], moved[:, :, 0] - moved[:, :, 1]
        length = np.linalg.norm(gap, axis=2)
        wanted = np.maximum((gap * step).sum(axis=2) / length, length / 2)
        for _ in range(SHAKES if len(self.wand.pairs) > 1 else 1):
            for e, (i, j) in enumerate(self.wand.pairs):
                gap = after[:, 0, i] - after[:, 0, j]
                excess = (1 - wanted[:, e, None] / np.linalg.norm(gap, axis=1, keepdims=True)) / 2 * gap
                after[:, 0, i] -= excess
                after[:, 0, j] += excess
        return after

    def _to_scale(self, state: State) -> State:
        """The state with the fixed distance as it is: nothing that cameras see tells a world from a larger one."""
        if self.fixed_distance is None:
            return state
        a, b, distance = self.fixed_distance
        factor = distance / float(np.linalg.norm(state.cameras[a, :3, 3] - state.cameras[b, :3, 3]))
        cameras = state.cameras.copy()
        cameras[:, :3, 3] *= factor
        return replace(state, cameras=cameras, motion=factor * state.motion)

    def freeing(self, *parameters: tuple[int, ...]) -> "Problem":
        """The same with other parameters sought."""
        return replace(self, free=tuple(sorted(sum(parameters, ()))))


def unobserved(state: State, free: tuple[int, ...]) -> Array:
    """(C d, g) how the cameras' free parameters change when the world turns and shifts, or all clocks together."""
    columns = np.zeros((len(state.cameras), PER_CAMERA + len(SHAPE), 8))
    for T, rows in zip(state.cameras, columns, strict=True):
        rows[:6, :6] = adjoint(invert(T))
        rows[6, 6] = rows[7, 7] = 1.0
    kept = [g for g in range(8) if g < 6 or g in free]
    return columns[:, free][:, :, kept].reshape(-1, len(kept))
