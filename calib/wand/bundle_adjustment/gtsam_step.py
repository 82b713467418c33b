# SPDX-License-Identifier: BSD-3-Clause
"""GTSAM's part of a wand's bundle adjustment, the steps: knots are eliminated first, then cameras."""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from calib.rig.camera import PER_CAMERA
from calib.wand.bundle_adjustment.linear_system import Linearisation
from calib.wand.bundle_adjustment.problem import Problem
from camera_node.arrays import Array, Index

NUMBERS = 24  # of one variable, at the least: fewer and larger factors, though most of their entries are zero

# Information that holds the first camera and its clock, about what observations give: of what all share, none tells.
ANCHOR = np.array([1e8] * 6 + [1e10, 1e13] + [0.0] * 4)
# Of the best known direction of a knot's place, and of its velocity: what holds the others. GTSAM takes pivots for
# singular that are 2^12 apart.
HELD = 2.0**-22


@dataclass(frozen=True, slots=True)
class _Spans:
    """A linearisation with some neighbouring knots as one variable, the last ones filled up with knots that are held.

    `views`, `rows`, `ends` and `chain` are those of `Linearisation`, by span in place of knot; `grown` (N, m) is what
    diagonals grow by.
    """

    views: Index
    rows: Array
    ends: Index
    chain: Array
    grown: Array

    @classmethod
    def of(cls, linear: Linearisation, grown: Array) -> "_Spans":
        """With diagonals that grow by (K, 6 B)."""
        half, cameras = grown.shape[1], len(linear.problem.lenses)
        knots = -(-NUMBERS // half)
        m, count = knots * half, -(-len(linear.chain) // knots)
        link, camera = np.divmod(np.repeat(linear.views, np.diff(linear.ends)), cameras)
        view = link // knots * cameras + camera
        order = np.argsort(view, kind="stable")
        first = np.flatnonzero(np.diff(view[order], prepend=-1))
        narrow, at = linear.rows[order], half * (link[order, None] % knots) + np.arange(2 * half)
        rows = np.zeros((len(view), 2 * m + narrow.shape[1] - 2 * half))
        np.put_along_axis(rows, at, narrow[:, : 2 * half], axis=1)
        rows[:, 2 * m :] = narrow[:, 2 * half :]
        chain = np.zeros((count, 2 * m + 1, 2 * m + 1))
        for k in range(knots):
            part = linear.chain[k::knots]
            inner = np.append(np.arange(half * k, half * (k + 2)), 2 * m)
            chain[: len(part), inner[:, None], inner] += part
        filled = np.ones(((count + 1) * knots, half))
        filled[: len(grown)] = grown
        return cls(view[order][first], rows, np.append(first, len(view)), chain, filled.reshape(-1, m))


def solve(linear: Linearisation, damping: float) -> tuple[Array, Array]:
    """Levenberg-Marquardt's step: (C, 12) of cameras and (K, 6 B) of the motion. Where all cameras are sought, the
    first and its clock stay, as nothing observes the world and the time that all share.

    The Hessian's diagonal is grown (Marquardt), and where one camera alone saw a knot, held along its ray.

    Raises:
        RuntimeError: the system is too near to singular; more damping helps.
    """
    import gtsam

    of_knots, of_cameras = linear.diagonal()
    parts = of_knots.reshape(len(of_knots), 2, -1)
    held = (HELD * parts.max(axis=2, keepdims=True) * np.ones_like(parts)).reshape(of_knots.shape)
    spans = _Spans.of(linear, damping * of_knots + held)
    graph, count, free = gtsam.GaussianFactorGraph(), len(spans.grown), list(linear.problem.free)
    _add_views(graph, linear.problem, spans)
    _add_motion(graph, spans)
    _add_rig(graph, linear, count)
    for camera in linear.problem.cameras():
        grown = damping * of_cameras[camera]
        graph.push_back(gtsam.HessianFactor(count + camera, np.diag(grown), 0 * grown, 0.0))
    if linear.problem.sought is None:
        graph.push_back(gtsam.HessianFactor(count, np.diag(ANCHOR[free]), 0 * ANCHOR[free], 0.0))
    step = graph.optimize(_ordering(linear.problem, count))
    by = np.zeros((len(linear.problem.lenses), PER_CAMERA))
    for camera in linear.problem.cameras():
        by[camera, free] = step.at(count + camera)
    along = np.array([step.at(key) for key in range(count)])
    return by, along.reshape(-1, of_knots.shape[1])[: len(of_knots)]


def _add_views(graph: Any, problem: Problem, spans: _Spans) -> None:
    """One factor a camera and span; a camera that is not sought is known."""
    import gtsam

    (count, m), rows = spans.grown.shape, spans.rows
    J1, J2, J3, b = rows[:, :m], rows[:, m : 2 * m], rows[:, 2 * m : -1], rows[:, -1]
    links, cameras = np.divmod(spans.views, len(problem.lenses))
    factor = cast(Any, gtsam.JacobianFactor)
    sought, ends = set(problem.cameras()), spans.ends.tolist()
    units = {n: gtsam.noiseModel.Unit.Create(n) for n in set(np.diff(ends).tolist())}
    for k, camera, i, j in zip(links.tolist(), cameras.tolist(), ends, ends[1:], strict=False):
        of_camera = (count + camera, J3[i:j]) if camera in sought else ()
        graph.push_back(factor(k, J1[i:j], k + 1, J2[i:j], *of_camera, b[i:j], units[j - i]))


def _add_motion(graph: Any, spans: _Spans) -> None:
    """What is known of the motion, with what diagonals grow by: span k stands in link k, the last one in the last."""
    import gtsam

    m, chain = spans.grown.shape[1], spans.chain.copy()
    diagonal = np.einsum("lii->li", chain)
    diagonal[:, :m] += spans.grown[:-1]
    diagonal[-1, m:-1] += spans.grown[-1]
    for k, H in enumerate(chain):
        G11, G12, g1 = H[:m, :m], H[:m, m:-1], H[:m, -1]
        graph.push_back(gtsam.HessianFactor(k, k + 1, G11, G12, g1, H[m:-1, m:-1], H[m:-1, -1], 0.0))


def _add_rig(graph: Any, linear: Linearisation, count: int) -> None:
    """What is known of the cameras, whose keys begin at `count`."""
    import gtsam

    sought = set(linear.problem.cameras())
    for keys, J, error in linear.rig:
        if sought.issuperset(keys):
            blocks = [part for key, block in zip(keys, J, strict=True) for part in (count + key, block)]
            unit = gtsam.noiseModel.Unit.Create(len(error))
            graph.push_back(cast(Any, gtsam.JacobianFactor)(*blocks, error, unit))


def _ordering(problem: Problem, count: int) -> Any:
    import gtsam

    ordering = gtsam.Ordering()
    for key in (*range(count), *(count + camera for camera in problem.cameras())):
        ordering.push_back(key)
    return ordering
