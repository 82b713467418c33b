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
OF_KNOTS = (0, 1, 3, 4, 6)  # G11, G12, g1, G22, g2 of a factor on two knots and a camera


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
    """GTSAM's graph: keys are the K knots, then the cameras."""
    import gtsam

    factor, hessian = cast(Any, gtsam.JacobianFactor), cast(Any, gtsam.HessianFactor)
    half, d = 6 * len(linear.problem.wand.basis), len(linear.problem.free)
    count, graph = len(linear.problem.knot_s), gtsam.GaussianFactorGraph()
    a, b, c = slice(0, half), slice(half, 2 * half), slice(2 * half, 2 * half + d)
    links, cameras = np.divmod(linear.views, len(linear.problem.lenses))
    parts = _split(_damped(linear.blocks, damping), [a, b, c])
    sought = set(linear.problem.cameras())
    for k, camera, *upper in zip(links.tolist(), cameras.tolist(), *parts, strict=True):
        if camera in sought:
            graph.push_back(hessian(k, k + 1, count + camera, *upper, 0.0))
        else:
            graph.push_back(hessian(k, k + 1, *(upper[j] for j in OF_KNOTS), 0.0))
    for k, upper in enumerate(zip(*_split(_damped(linear.chain, damping), [a, b]), strict=True)):
        graph.push_back(hessian(k, k + 1, *upper, 0.0))
    for keys, J, error in linear.rig:
        if not sought.issuperset(keys):
            continue
        unit = gtsam.noiseModel.Unit.Create(len(error))
        blocks: list[Any] = [
            part for key, block in zip(keys, J, strict=True) for part in (count + key, block)
        ]
        graph.push_back(factor(*blocks, error, unit))
    return graph


def _ordering(problem: Problem, knots: bool, cameras: bool) -> Any:
    import gtsam

    ordering, count = gtsam.Ordering(), len(problem.knot_s)
    for key in range(count if knots else 0):
        ordering.push_back(key)
    for camera in problem.cameras() if cameras else ():
        ordering.push_back(count + camera)
    return ordering


def _split(blocks: Array, parts: list[slice]) -> list[Array]:
    """The upper triangle of augmented Hessians (n, m, m) as GTSAM takes it, block by block, by columns as Eigen has
    them: G11, G12, .., g1, G22, .., g2, .."""
    found = []
    for k, rows in enumerate(parts):
        for columns in parts[k:]:
            found.append(np.swapaxes(np.ascontiguousarray(np.swapaxes(blocks[:, rows, columns], 1, 2)), 1, 2))
        found.append(np.ascontiguousarray(blocks[:, rows, -1]))
    return found


def _damped(blocks: Array, damping: float) -> Array:
    """The Hessians with their diagonals grown (Marquardt), all but the right-hand side's."""
    grown, diagonal = blocks.copy(), np.arange(blocks.shape[1] - 1)
    grown[:, diagonal, diagonal] *= 1 + damping
    return grown
