# SPDX-License-Identifier: BSD-3-Clause
"""Compares the lenses of an adjustment with those of the rig file.

The adjustment corrects the focal length, the principal point and k1; `find_lens_changes` reports by how much. It takes
fx / fy and the distortion coefficients after k1 as known; `find_misfit` tests these (Rao's score test, 1948): one
Gauss-Newton step from the converged adjustment, with these parameters free, estimates them to first order, with a
covariance. The test does not change the rig: a calibration board determines these parameters better than a wand.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.rig.camera import LENS, SHAPE
from calib.wand.bundle_adjustment.covariance import camera_covariance, inverse_information
from calib.wand.bundle_adjustment.linear_system import linearize
from calib.wand.bundle_adjustment.optimizer import Adjusted
from calib.wand.bundle_adjustment.problem import WandObservations
from calib.wand.bundle_adjustment.residuals import find_weights
from calib.wand.bundle_adjustment.schur_complement import eliminate_motion
from camera_node.arrays import Array
from camera_node.geometry.lens import Lens

CLEAR = 2.0  # sigmas, root mean square of the four parameters, above which a lens is reported as changed
SIGNIFICANT = 1e-4  # probability below which a lens differs from its file in the other parameters
NAMES = {"pinhole": ("fx / fy", "k2", "p1", "p2"), "fisheye": ("fx / fy", "k2", "k3", "k4")}


@dataclass(frozen=True, slots=True)
class LensChange:
    """A lens before and after the adjustment.

    Attributes:
        before, after: the lens.
        sigma: (4,) standard deviations of log focal length, cx, cy and k1 after it.
        sigmas: the change in these, root mean square of the four.
    """

    before: Lens
    after: Lens
    sigma: Array
    sigmas: float

    def sentence(self) -> str:
        """The change in words."""
        a, b, (f, cx, cy, k1) = self.before, self.after, self.sigma.tolist()
        return (
            f"f {a.fx:.1f} -> {b.fx:.1f} ± {f * b.fx:.1f} px, centre {a.cx:.1f} -> {b.cx:.1f} ± {cx:.1f}, "
            f"{a.cy:.1f} -> {b.cy:.1f} ± {cy:.1f} px, k1 {_k1(a):.4f} -> {_k1(b):.4f} ± {k1:.4f}"
        )

    def as_dict(self) -> dict[str, Any]:
        """The values before, and standard deviations after, for the `calibration` map of `rig.yaml`."""
        f, cx, cy, k1 = self.sigma.tolist()
        before = {"fx": self.before.fx, "fy": self.before.fy, "cx": self.before.cx, "cy": self.before.cy}
        sigma = {"fx": f * self.after.fx, "fy": f * self.after.fy, "cx": cx, "cy": cy, "k1": k1}
        return {
            "before": {**before, "k1": _k1(self.before)},
            "sigma": {name: round(value, 5) for name, value in sigma.items()},
            "sigmas": round(self.sigmas, 2),
        }


def find_lens_changes(names: Sequence[str], adjusted: Adjusted) -> dict[str, LensChange]:
    """The change of every lens, by camera."""
    covariance, changes = camera_covariance(adjusted).of(LENS), {}
    for k, (name, lens) in enumerate(zip(names, adjusted.problem.lenses, strict=True)):
        change, cov = adjusted.state.lenses[k], covariance[k, :, k]
        sigmas = float(np.sqrt(change @ np.linalg.solve(cov, change) / len(change)))
        changes[name] = LensChange(lens, adjusted.state.lens(k, lens), np.sqrt(np.diag(cov)), sigmas)
    return changes


def describe_lens_changes(changes: dict[str, LensChange]) -> list[str]:
    """The significant changes for the user, line by line."""
    clear = {name: change for name, change in changes.items() if change.sigmas > CLEAR}
    lines = (
        ["the recording corrects lenses; the written rig has the new values (before -> after)"]
        if clear
        else []
    )
    lines += [f"lens of {name}: {change.sentence()}" for name, change in clear.items()]
    if rest := [name for name in changes if name not in clear]:
        lines.append(
            f"unchanged within {CLEAR:g} sigmas: the lens{'es' * (len(rest) > 1)} of {', '.join(rest)}"
        )
    return lines


def _k1(lens: Lens) -> float:
    return lens.distortion[0] if lens.distortion else 0.0


@dataclass(frozen=True, slots=True)
class Misfit:
    """The parameter of a camera's lens that differs most from its file: the file's value, the estimate, and its
    standard deviation."""

    camera: str
    parameter: str
    given: float
    estimate: float
    sigma: float

    def sentence(self) -> str:
        """The difference in words, and what to do."""
        return (
            f"warning: the lens of {self.camera} differs from its file: {self.parameter} is {self.estimate:.4f} "
            f"\N{PLUS-MINUS SIGN} {self.sigma:.4f} by the recording, {self.given:.4f} in the file; a wand recording "
            "does not correct that, and the rig's errors may be larger than reported: run python -m calib intrinsics "
            f"--camera {self.camera}"
        )


def find_misfit(names: Sequence[str], adjusted: Adjusted, observations: WandObservations) -> Misfit | None:
    """The camera whose lens differs most from its file; None if no difference is significant.

    Only the worst is named, because a wrong lens makes others look wrong.

    Args:
        names: of the C cameras.
        adjusted, observations: a converged adjustment.
    """
    from scipy.special import chdtrc

    steps, covariance = _score_step(adjusted, observations)
    squares = np.array(
        [step @ np.linalg.solve(cov, step) for step, cov in zip(steps, covariance, strict=True)]
    )
    k = int(squares.argmax())
    if chdtrc(len(SHAPE), squares[k]) * len(names) > SIGNIFICANT:
        return None
    sigma = np.sqrt(np.diag(covariance[k]))
    worst = int(np.abs(steps[k] / sigma).argmax())
    lens = adjusted.problem.lenses[k]
    given = lens_shape(lens)[worst]
    scale = given if worst == 0 else 1.0
    estimate = given * np.exp(steps[k, 0]) if worst == 0 else given + steps[k, worst]
    return Misfit(names[k], NAMES[lens.model][worst], given, float(estimate), float(scale * sigma[worst]))


def _score_step(adjusted: Adjusted, observations: WandObservations) -> tuple[Array, Array]:
    """Corrections (C, 4) of all lenses' shapes by one step, and their covariances (C, 4, 4)."""
    problem = adjusted.problem.with_free(adjusted.problem.free, SHAPE)
    inliers, state = observations.select(adjusted.used), adjusted.state
    system = linearize(problem, inliers, state, find_weights(problem, inliers, state))
    cameras = eliminate_motion(system)
    inverse = inverse_information(replace(adjusted, problem=problem, information=cameras.information))
    count, d = len(problem.lenses), len(problem.free)
    gradient = np.zeros((count, d))
    for prior in system.priors:
        gradient[prior.cameras[0]] += prior.jacobians[0].T @ prior.error
    gradient = cameras.scores.sum(axis=0) + gradient.ravel()
    step = (inverse @ gradient).reshape(count, d)[:, -len(SHAPE) :]
    blocks = inverse.reshape(count, d, count, d)[:, -len(SHAPE) :, :, -len(SHAPE) :]
    variance = adjusted.scale**2 * adjusted.inflation
    return step, variance * np.array([blocks[k, :, k] for k in range(count)])


def lens_shape(lens: Lens) -> Array:
    """(4,) fx / fy, and the three distortion coefficients after k1."""
    return np.array([lens.fx / lens.fy, *(*lens.distortion, 0.0, 0.0, 0.0, 0.0)[1:4]])
