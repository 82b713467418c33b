# SPDX-License-Identifier: BSD-3-Clause
"""Solves for a Levenberg-Marquardt step with GTSAM, which eliminates the knots first, then the cameras."""

from dataclasses import dataclass
from itertools import combinations
from typing import Any, cast

import numpy as np

from calib.rig.camera import PER_CAMERA, READOUT
from calib.wand.bundle_adjustment.linear_system import LinearSystem
from calib.wand.bundle_adjustment.problem import Problem
from camera_node.foundation.arrays import Array, Index

GROUP_SIZE = 24  # scalars in one variable, at least: few large factors are faster, though mostly zero

# Information that fixes the gauge at the first camera and its clock: about the information of the observations. Readout
# times and lenses are no part of the gauge.
ANCHOR = np.array([1e8] * 6 + [1e10, 1e13] + [0.0] * (PER_CAMERA - READOUT[0]))
# Damping of a knot's position and velocity, of the information in the best observed direction of each: GTSAM takes
# pivots that are 2^12 apart for singular.
MIN_RELATIVE_INFORMATION = 2.0**-22


@dataclass(frozen=True, slots=True)
class _KnotGroups:
    """A linear system with consecutive knots grouped into one variable, padded with fixed knots at the end.

    `views`, `rows`, `bounds` and `chain` are those of `LinearSystem`, by group in place of knot; `damping` (N, m) is
    added to the diagonal.
    """

    views: Index
    rows: Array
    bounds: Index
    chain: Array
    damping: Array

    @classmethod
    def of(cls, system: LinearSystem, damping: Array) -> "_KnotGroups":
        """Group the knots of a system, with `damping` (K, 6 B)."""
        half, cameras = damping.shape[1], len(system.problem.lenses)
        knots = -(-GROUP_SIZE // half)
        m, count = knots * half, -(-len(system.chain) // knots)
        interval, camera = np.divmod(np.repeat(system.views, np.diff(system.bounds)), cameras)
        view = interval // knots * cameras + camera
        order = np.argsort(view, kind="stable")
        first = np.flatnonzero(np.diff(view[order], prepend=-1))
        narrow, at = system.rows[order], half * (interval[order, None] % knots) + np.arange(2 * half)
        rows = np.zeros((len(view), 2 * m + narrow.shape[1] - 2 * half))
        np.put_along_axis(rows, at, narrow[:, : 2 * half], axis=1)
        rows[:, 2 * m :] = narrow[:, 2 * half :]
        chain = np.zeros((count, 2 * m + 1, 2 * m + 1))
        for k in range(knots):
            part = system.chain[k::knots]
            inner = np.append(np.arange(half * k, half * (k + 2)), 2 * m)
            chain[: len(part), inner[:, None], inner] += part
        padded = np.ones(((count + 1) * knots, half))
        padded[: len(damping)] = damping
        return cls(view[order][first], rows, np.append(first, len(view)), chain, padded.reshape(-1, m))


def solve_step(system: LinearSystem, damping: float) -> tuple[Array, Array]:
    """Solve for the step of Levenberg-Marquardt: (C, 12) of the cameras and (K, 6 B) of the motion.

    The Hessian's diagonal is multiplied by 1 + `damping` (Marquardt); a knot that only one camera observed is damped
    along its viewing ray. Where all cameras are estimated, the first camera and its clock are fixed (gauge).

    Raises:
        RuntimeError: the system is nearly singular; more damping helps.
    """
    import gtsam

    problem = system.problem
    of_knots, of_cameras = system.diagonal()
    parts = of_knots.reshape(len(of_knots), 2, -1)
    least = MIN_RELATIVE_INFORMATION * parts.max(axis=2, keepdims=True) * np.ones_like(parts)
    groups = _KnotGroups.of(system, damping * of_knots + least.reshape(of_knots.shape))
    graph, count, free = gtsam.GaussianFactorGraph(), len(groups.damping), list(problem.free)
    _add_views(graph, problem, groups)
    _add_motion(graph, groups)
    _add_priors(graph, system, count)
    _add_background(graph, system, count)
    for camera in problem.estimated_cameras():
        added = damping * of_cameras[camera]
        graph.push_back(gtsam.HessianFactor(count + camera, np.diag(added), 0 * added, 0.0))
    if problem.estimated is None:
        graph.push_back(gtsam.HessianFactor(count, np.diag(ANCHOR[free]), 0 * ANCHOR[free], 0.0))
    step = graph.optimize(_ordering(problem, count))
    camera_step = np.zeros((len(problem.lenses), PER_CAMERA))
    for camera in problem.estimated_cameras():
        camera_step[camera, free] = step.at(count + camera)
    motion_step = np.array([step.at(key) for key in range(count)])
    return camera_step, motion_step.reshape(-1, of_knots.shape[1])[: len(of_knots)]


def _add_views(graph: Any, problem: Problem, groups: _KnotGroups) -> None:
    """Add one factor for each camera and group of knots; fixed cameras are no variables."""
    import gtsam

    (count, m), rows = groups.damping.shape, groups.rows
    J1, J2, J3, b = rows[:, :m], rows[:, m : 2 * m], rows[:, 2 * m : -1], rows[:, -1]
    first, cameras = np.divmod(groups.views, len(problem.lenses))
    factor = cast(Any, gtsam.JacobianFactor)
    estimated, bounds = set(problem.estimated_cameras()), groups.bounds.tolist()
    units = {n: gtsam.noiseModel.Unit.Create(n) for n in set(np.diff(bounds).tolist())}
    for k, camera, i, j in zip(first.tolist(), cameras.tolist(), bounds, bounds[1:], strict=False):
        of_camera = (count + camera, J3[i:j]) if camera in estimated else ()
        graph.push_back(factor(k, J1[i:j], k + 1, J2[i:j], *of_camera, b[i:j], units[j - i]))


def _add_motion(graph: Any, groups: _KnotGroups) -> None:
    """Add the motion terms and the damping, group k's own with group k + 1's, the last group's with the last pair."""
    import gtsam

    m, chain = groups.damping.shape[1], groups.chain.copy()
    diagonal = np.einsum("lii->li", chain)
    diagonal[:, :m] += groups.damping[:-1]
    diagonal[-1, m:-1] += groups.damping[-1]
    for k, H in enumerate(chain):
        G11, G12, g1 = H[:m, :m], H[:m, m:-1], H[:m, -1]
        graph.push_back(gtsam.HessianFactor(k, k + 1, G11, G12, g1, H[m:-1, m:-1], H[m:-1, -1], 0.0))


def _add_priors(graph: Any, system: LinearSystem, count: int) -> None:
    """Add the priors of the estimated cameras, whose keys begin at `count`."""
    import gtsam

    estimated = set(system.problem.estimated_cameras())
    for prior in system.priors:
        if estimated.issuperset(prior.cameras):
            pairs = zip(prior.cameras, prior.jacobians, strict=True)
            blocks = [part for camera, block in pairs for part in (count + camera, block)]
            unit = gtsam.noiseModel.Unit.Create(len(prior.error))
            graph.push_back(cast(Any, gtsam.JacobianFactor)(*blocks, prior.error, unit))


def _add_background(graph: Any, system: LinearSystem, count: int) -> None:
    """Add what the background points say about the estimated cameras, whose keys begin at `count`: one factor for each
    camera, and one for each pair; only their sum is positive definite."""
    import gtsam

    if not len(system.problem.background):
        return
    H, g = system.background.information, system.background.scores.sum(axis=0)
    zero, none = np.zeros_like(H[0, :, 0]), np.zeros_like(g[0])
    cameras = system.problem.estimated_cameras()
    for camera in cameras:
        graph.push_back(gtsam.HessianFactor(count + camera, H[camera, :, camera], g[camera], 0.0))
    for a, b in combinations(cameras, 2):
        both = H[a, :, b]
        if both.any():
            graph.push_back(gtsam.HessianFactor(count + a, count + b, zero, both, none, zero, none, 0.0))


def _ordering(problem: Problem, count: int) -> Any:
    import gtsam

    ordering = gtsam.Ordering()
    for key in (*range(count), *(count + camera for camera in problem.estimated_cameras())):
        ordering.push_back(key)
    return ordering
