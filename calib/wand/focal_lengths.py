# SPDX-License-Identifier: BSD-3-Clause
"""Finds rough focal lengths of cameras whose lenses are unknown, before any pose: the adjustment starts from them.

The fundamental matrix of two cameras has seven degrees of freedom, an essential matrix five, which leaves two equations
for two focal lengths where the principal points are known (Hartley and Zisserman, section 19.3). They are degenerate
where optical axes meet, as on a ring of cameras that look at its middle, so no pair is solved on its own. Each pair
gives a table instead: for every two focal lengths of a grid, the least squares of the Sampson distances over all
essential matrices. The sum of the tables and of the lenses' priors is the negative logarithm of the likelihood of all
focal lengths. A grid has no local minimum that is missed, and where the sum is flat the priors decide.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np

from calib.rig.coverage import spread_evenly
from calib.rig.estimation import CAUCHY_SCALE, MEDIAN_DEVIATION, STEPS, cauchy_weights
from calib.rig.rig import Rig
from calib.wand.bundle_adjustment.covariance import FOCAL, calibrated_sigma
from calib.wand.bundle_adjustment.problem_setup import MIN_SIGMA_PX
from calib.wand.initial_rig import GATE_PX, MIN_COMMON, TwoViewGeometry, sampson
from calib.wand.labels import label_recording
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import rotation_from_vector, skew
from camera_node.protocol.messages import Detections

# Of a grid, within two standard deviations: a quarter apart, where lenses are known by a factor of two
GRID = 9
SAMPLE = 150  # correspondences of a pair
PARTNERS = 4  # of a camera, those with most frame sets in common: more change no start
SINGULAR = np.diag([1.0, 1.0, 0.0])  # values of an essential matrix


@dataclass(frozen=True, slots=True)
class _Table:
    """Half the squared misfits (GRID, GRID) of the cameras a and b by the focal lengths of their grids."""

    a: int
    b: int
    misfit: Array


def with_rough_focal_lengths(rig: Rig, wand: Body, messages: Sequence[Detections]) -> Rig:
    """The rig with rough focal lengths of the lenses that are not known as well as those of data sheets.

    Args:
        rig: the lenses; others than those whose `lens_sigma` is larger than usual stay.
        wand: its markers.
        messages: detections of all cameras, their clocks nearly right.

    Raises:
        CalibrationError: see `label_recording`.
    """
    if all(_focal_sigma(lens) <= FOCAL for lens in rig.cameras.values()):  # as known as by data sheets
        return rig
    recording = label_recording(rig, wand, messages)
    pairs = TwoViewGeometry(recording.detections, recording.lenses, wand, recording.timing)
    sigma = np.array([_focal_sigma(rig.cameras[name]) for name in recording.names])
    sigma[sigma <= FOCAL] = 0.0
    factors, cameras = find_focal_factors(pairs, sigma), dict(rig.cameras)
    for name, factor in zip(recording.names, factors.tolist(), strict=True):
        lens = cameras[name]
        cameras[name] = lens.with_parameters([factor * lens.fx, factor * lens.fy, *lens.parameters[2:]])
    return msgspec.structs.replace(rig, cameras=cameras)


def _focal_sigma(lens: Lens) -> float:
    sigma = calibrated_sigma(lens)
    return FOCAL if sigma is None else float(sigma[0])


def find_focal_factors(pairs: TwoViewGeometry, sigma: Array) -> Array:
    """(C,) true over given focal lengths, roughly.

    Args:
        pairs: two-view geometry by the given lenses.
        sigma: (C,) prior standard deviations of the logarithms of the focal lengths; 0 of known lenses.
    """
    steps = np.linspace(-2, 2, GRID)
    grids = np.exp(sigma[:, None] * steps)
    tables = [table for a, b in _choose_pairs(pairs) if (table := _tabulate(pairs, a, b, grids)) is not None]
    starts = [_descend(np.full(len(sigma), k, np.intp), tables, steps**2 / 2) for k in range(GRID)]
    best = min(starts, key=lambda start: start[1])[0]
    return np.take_along_axis(grids, best[:, None], axis=1)[:, 0]


def _choose_pairs(pairs: TwoViewGeometry) -> list[tuple[int, int]]:
    """The pairs of each camera with those that share most frame sets with it."""
    shared = pairs.count_shared()
    np.fill_diagonal(shared, 0)
    best = np.argsort(-shared, axis=1)[:, :PARTNERS]
    chosen = {(min(a, b), max(a, b)) for a, row in enumerate(best.tolist()) for b in row if shared[a, b]}
    return sorted(chosen)


def _descend(choice: Index, tables: Sequence[_Table], prior: Array) -> tuple[Index, float]:
    """The grid steps (C,) of a minimum of the sum of tables and priors, one camera after the other, and the sum."""
    while True:
        before = choice.copy()
        for camera in range(len(choice)):
            total = prior.copy()
            for table in tables:
                if camera == table.a:
                    total += table.misfit[:, choice[table.b]]
                elif camera == table.b:
                    total += table.misfit[choice[table.a]]
            choice[camera] = int(total.argmin())
        if (choice == before).all():
            value = sum(table.misfit[choice[table.a], choice[table.b]] for table in tables)
            return choice, float(value + prior[choice].sum())


def _tabulate(pairs: TwoViewGeometry, a: int, b: int, grids: Array) -> _Table | None:
    """The table of two cameras; None where they share too few images, or their epipolar geometry is not found."""
    focal = [(lens.fx + lens.fy) / 2 for lens in (pairs.lenses[a], pairs.lenses[b])]
    x_a, x_b = (
        f * xy[spread_evenly(len(xy), SAMPLE)] for f, xy in zip(focal, pairs.correspond(a, b), strict=True)
    )
    if len(x_a) < MIN_COMMON:
        return None
    found = cv2.findFundamentalMat(x_a, x_b, cv2.USAC_ACCURATE, GATE_PX, 0.9999, 2000)[0]
    if found is None or found.shape != (3, 3):
        return None
    F = np.asarray(found, float)
    sigma = max(float(np.median(sampson(F, x_a, x_b))) / MEDIAN_DEVIATION, MIN_SIGMA_PX)
    f_a, f_b = (f.ravel() for f in np.meshgrid(grids[a] * focal[0], grids[b] * focal[1], indexing="ij"))
    h_a, h_b = (np.column_stack([x, np.ones(len(x))]) for x in (x_a, x_b))
    inverse_a, inverse_b = (
        np.eye(3) * np.column_stack([1 / f, 1 / f, np.ones(len(f))])[:, None] for f in (f_a, f_b)
    )
    matrices = _EssentialMatrices(h_a, h_b, inverse_a, inverse_b, sigma)
    return _Table(a, b, matrices.fit(F).reshape(GRID, GRID))


@dataclass(frozen=True, slots=True)
class _EssentialMatrices:
    """The epipolar constraints of n images in two cameras, for g pairs of focal lengths.

    An essential matrix is U diag(1, 1, 0) V, of which a step turns U and V.

    Attributes:
        h_a, h_b: (n, 3) homogeneous pixels, from the images' centres.
        inverse_a, inverse_b: (g, 3, 3) inverses of the calibration matrices.
        sigma: of a Sampson distance, pixels.
    """

    h_a: Array
    h_b: Array
    inverse_a: Array
    inverse_b: Array
    sigma: float

    def fit(self, F: Array) -> Array:
        """Half the least squared misfits (g,) under Cauchy's kernel, by Levenberg-Marquardt from the essential matrices
        nearest to a fundamental matrix."""
        U, _, V = np.linalg.svd(np.linalg.inv(self.inverse_b) @ F @ np.linalg.inv(self.inverse_a))
        errors, slopes = self._errors(U, V)
        cost, damping = _cost(errors), np.full(len(U), 1e-3)
        for _ in range(STEPS):
            J = self._jacobians(U, V, slopes)
            weighted = J * cauchy_weights(errors, CAUCHY_SCALE)[:, :, None]
            H = np.swapaxes(weighted, 1, 2) @ J
            H += (damping * np.einsum("gii->g", H))[:, None, None] * np.eye(6)
            step = -np.linalg.solve(H, np.swapaxes(weighted, 1, 2) @ errors[:, :, None])[:, :, 0]
            turned = U @ rotation_from_vector(step[:, :3]), rotation_from_vector(step[:, 3:]) @ V
            after = self._errors(*turned)
            better = _cost(after[0]) < cost
            damping = np.where(better, np.maximum(damping / 10, 1e-6), damping * 10)
            for old, new in zip((U, V, errors, slopes), (*turned, *after), strict=True):
                old[better] = new[better]
            cost = _cost(errors)
        return cost

    def _errors(self, U: Array, V: Array) -> tuple[Array, Array]:
        """(g, n) Sampson distances in standard deviations, and the slopes by which epipolar errors are divided."""
        F = self.inverse_b @ U @ SINGULAR @ V @ self.inverse_a
        line_b, line_a = self.h_a @ np.swapaxes(F, 1, 2), self.h_b @ F
        slopes = self.sigma * np.sqrt((line_b[..., :2] ** 2 + line_a[..., :2] ** 2).sum(axis=2))
        return (line_b * self.h_b).sum(axis=2) / slopes, slopes

    def _jacobians(self, U: Array, V: Array, slopes: Array) -> Array:
        """(g, n, 6) derivatives of the errors by turns of U and V, with constant slopes."""
        turns, products = skew(np.eye(3)), (self.h_b[:, :, None] * self.h_a[:, None]).reshape(-1, 9)
        by_turns = np.concatenate([turns @ SINGULAR, SINGULAR @ turns])
        by_turns = (self.inverse_b @ U)[:, None] @ by_turns @ (V @ self.inverse_a)[:, None]
        return products @ np.swapaxes(by_turns.reshape(-1, 6, 9), 1, 2) / slopes[:, :, None]


def _cost(errors: Array) -> Array:
    return CAUCHY_SCALE**2 / 2 * np.log1p((errors / CAUCHY_SCALE) ** 2).sum(axis=1)
