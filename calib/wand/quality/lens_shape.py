# SPDX-License-Identifier: BSD-3-Clause
"""Whether what a wave takes for known of a lens is so: the ratio of its focal lengths, and its distortion after k1.

Rao's score test (1948): where the adjustment ended, one Gauss-Newton step with these parameters sought as well is their
estimate, to first order, and says how far it is from what the file has. Nothing is adjusted by it: a board sees such
terms better than a waving hand.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.rig.camera import SHAPE
from calib.wand.bundle_adjustment.covariance import inverse_information
from calib.wand.bundle_adjustment.linear_system import linearize
from calib.wand.bundle_adjustment.optimizer import Adjusted
from calib.wand.bundle_adjustment.problem import WandObservations
from calib.wand.bundle_adjustment.residuals import find_weights
from calib.wand.bundle_adjustment.schur_complement import eliminate_motion
from camera_node.arrays import Array
from camera_node.geometry.lens import Lens

WRONG = 1e-4  # probability below which a lens is not what its file says
NAMES = {"pinhole": ("fx / fy", "k2", "p1", "p2"), "fisheye": ("fx / fy", "k2", "k3", "k4")}


@dataclass(frozen=True, slots=True)
class Misfit:
    """The parameter of a camera's lens that is farthest from its file: what it is there, what the wave says, and the
    standard deviation of that."""

    camera: str
    parameter: str
    told: float
    found: float
    sigma: float

    def sentence(self) -> str:
        """What is wrong, and what to do."""
        return (
            f"warning: the lens of {self.camera} is not as its file says: by the wave {self.parameter} is "
            f"{self.found:.4f} \N{PLUS-MINUS SIGN} {self.sigma:.4f}, there {self.told:.4f}; a wave does not correct "
            f"that, and the rig may be off by more than is told: run python -m calib intrinsics --camera {self.camera}"
        )


def find_misfit(names: Sequence[str], adjusted: Adjusted, seen: WandObservations) -> Misfit | None:
    """The camera whose lens is least what was given, beyond what a wave adjusts: one that is wrong makes others look
    wrong, so the worst is named alone. None where all are.

    Args:
        names: of the C cameras.
        adjusted, seen: an adjustment that ended, and its observations.
    """
    from scipy.special import chdtrc

    off, covariance = _step(adjusted, seen)
    squares = np.array([o @ np.linalg.solve(S, o) for o, S in zip(off, covariance, strict=True)])
    k = int(squares.argmax())
    if chdtrc(len(SHAPE), squares[k]) * len(names) > WRONG:
        return None
    sigma = np.sqrt(np.diag(covariance[k]))
    worst = int(np.abs(off[k] / sigma).argmax())
    lens = adjusted.problem.lenses[k]
    told = shape_of(lens)[worst]
    scale = told if worst == 0 else 1.0
    found = told * np.exp(off[k, 0]) if worst == 0 else told + off[k, worst]
    return Misfit(names[k], NAMES[lens.model][worst], told, float(found), float(scale * sigma[worst]))


def _step(adjusted: Adjusted, seen: WandObservations) -> tuple[Array, Array]:
    """By how much each lens is off, (C, 4), and the covariances (C, 4, 4)."""
    problem = adjusted.problem.with_free(adjusted.problem.free, SHAPE)
    inliers, state = seen.select(adjusted.used), adjusted.state
    system = linearize(problem, inliers, state, find_weights(problem, inliers, state))
    cameras = eliminate_motion(system)
    freed = replace(adjusted, problem=problem, information=cameras.information)
    count, d = len(problem.lenses), len(problem.free)
    pulled = np.zeros((count, d))
    for prior in system.priors:
        pulled[prior.cameras[0]] += prior.jacobians[0].T @ prior.error
    inverse = inverse_information(freed)
    step = (inverse @ (cameras.scores.sum(axis=0) + pulled.ravel())).reshape(count, d)[:, -len(SHAPE) :]
    blocks = inverse.reshape(count, d, count, d)[:, -len(SHAPE) :, :, -len(SHAPE) :]
    noise = adjusted.scale**2 * adjusted.inflation
    return step, noise * np.array([blocks[k, :, k] for k in range(count)])


def shape_of(lens: Lens) -> Array:
    """(4,) fx over fy, and the three distortion numbers after k1."""
    return np.array([lens.fx / lens.fy, *(*lens.distortion, 0.0, 0.0, 0.0, 0.0)[1:4]])
