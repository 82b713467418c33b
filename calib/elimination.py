# SPDX-License-Identifier: BSD-3-Clause
"""GTSAM's part of a wand's bundle adjustment: knots are eliminated first, then cameras."""

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from calib.linearisation import Linearisation
from calib.problem import PER_CAMERA, Problem, State

Array = NDArray[np.float64]

# Information that holds the first camera and its clock, about what observations give: of what all share, none tells.
ANCHOR = np.array([1e8] * 6 + [1e10, 1e13] + [0.0] * 4)
# Of the best known direction of a knot's place, and of its velocity: what holds the others. GTSAM takes pivots for
# singular that are 2^12 apart.
HELD = 2.0**-22


def solve(linear: Linearisation, damping: float) -> tuple[Array, Array]:
    """Levenberg-Marquardt's step: (C, 12) of cameras and (K, 6 B) of the motion. Where all cameras are sought, the
    first and its clock stay, as nothing observes the world and the time that all share.

    Raises:
        RuntimeError: the system is too near to singular; more damping helps.
    """
    import gtsam

    count, free, graph = len(linear.problem.knot_s), list(linear.problem.free), _graph(linear, damping)
    if linear.problem.sought is None:
        graph.push_back(gtsam.HessianFactor(count, np.diag(ANCHOR[free]), 0 * ANCHOR[free], 0.0))
    step = graph.optimize(_ordering(linear.problem, True, True))
    by = np.zeros((len(linear.problem.lenses), PER_CAMERA))
    for camera in linear.problem.cameras():
        by[camera, free] = step.at(count + camera)
    return by, np.array([step.at(key) for key in range(count)])


def camera_information(linear: Linearisation, state: State) -> Array:
    """(S d, S d) information of the S sought cameras' free parameters with the motion eliminated (Schur
    complement)."""
    linear.relinearise(state, np.ones(len(linear.observations)), np.ones(len(linear.smooth)))
    rest = _graph(linear, 0.0).eliminatePartialMultifrontal(_ordering(linear.problem, True, False))[1]
    return np.asarray(rest.hessian(_ordering(linear.problem, False, True))[0])


def _graph(linear: Linearisation, damping: float) -> Any:
    """GTSAM's graph: keys are the K knots, then the cameras. The Hessian's diagonal is grown (Marquardt), and where one
    camera alone saw a knot, held along its ray."""
    import gtsam

    graph, (of_knots, of_cameras) = gtsam.GaussianFactorGraph(), linear.diagonal()
    _add_views(graph, linear)
    parts = of_knots.reshape(len(of_knots), 2, -1)
    held = (HELD * parts.max(axis=2, keepdims=True) * np.ones_like(parts)).reshape(of_knots.shape)
    _add_motion(graph, linear.chain, damping * of_knots + held)
    _add_rig(graph, linear)
    for camera in linear.problem.cameras() if damping else ():
        grown = damping * of_cameras[camera]
        graph.push_back(gtsam.HessianFactor(len(of_knots) + camera, np.diag(grown), 0 * grown, 0.0))
    return graph


def _add_views(graph: Any, linear: Linearisation) -> None:
    """One factor a camera and interval; a camera that is not sought is known."""
    import gtsam

    half, count, rows = 6 * len(linear.problem.wand.basis), len(linear.problem.knot_s), linear.rows
    J1, J2, J3, b = rows[:, :half], rows[:, half : 2 * half], rows[:, 2 * half : -1], rows[:, -1]
    links, cameras = np.divmod(linear.views, len(linear.problem.lenses))
    factor = cast(Any, gtsam.JacobianFactor)
    sought, ends = set(linear.problem.cameras()), linear.ends.tolist()
    units = {n: gtsam.noiseModel.Unit.Create(n) for n in set(np.diff(linear.ends).tolist())}
    for k, camera, i, j in zip(links.tolist(), cameras.tolist(), ends, ends[1:], strict=False):
        of_camera = (count + camera, J3[i:j]) if camera in sought else ()
        graph.push_back(factor(k, J1[i:j], k + 1, J2[i:j], *of_camera, b[i:j], units[j - i]))


def _add_motion(graph: Any, chain: Array, grown: Array) -> None:
    """What is known of the motion, (L, m, m) augmented Hessians of neighbouring knots, and what their diagonals grow
    by: knot k stands in link k, the last one in the last link."""
    import gtsam

    half, chain = grown.shape[1], chain.copy()
    diagonal = np.einsum("lii->li", chain)
    diagonal[:, :half] += grown[:-1]
    diagonal[-1, half:-1] += grown[-1]
    for k, H in enumerate(chain):
        G11, G12, g1 = H[:half, :half], H[:half, half:-1], H[:half, -1]
        graph.push_back(gtsam.HessianFactor(k, k + 1, G11, G12, g1, H[half:-1, half:-1], H[half:-1, -1], 0.0))


def _add_rig(graph: Any, linear: Linearisation) -> None:
    """What is known of the cameras."""
    import gtsam

    count, sought = len(linear.problem.knot_s), set(linear.problem.cameras())
    for keys, J, error in linear.rig:
        if sought.issuperset(keys):
            blocks = [part for key, block in zip(keys, J, strict=True) for part in (count + key, block)]
            unit = gtsam.noiseModel.Unit.Create(len(error))
            graph.push_back(cast(Any, gtsam.JacobianFactor)(*blocks, error, unit))


def _ordering(problem: Problem, knots: bool, cameras: bool) -> Any:
    import gtsam

    ordering, count = gtsam.Ordering(), len(problem.knot_s)
    for key in range(count if knots else 0):
        ordering.push_back(key)
    for camera in problem.cameras() if cameras else ():
        ordering.push_back(count + camera)
    return ordering
