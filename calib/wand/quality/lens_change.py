# SPDX-License-Identifier: BSD-3-Clause
"""What a wave changed of the lenses that it was given."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.rig.camera import LENS
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.bundle_adjustment.optimizer import Adjusted
from camera_node.arrays import Array
from camera_node.geometry.lens import Lens

CLEAR = 2.0  # sigmas, root mean square of the four parameters: below, a lens is as it was given


@dataclass(frozen=True, slots=True)
class LensChange:
    """A lens before and after, and the standard deviations (4,) of log focal length, cx, cy and k1; `sigmas` is how far
    it is from what was given, by its covariance, root mean square of the four."""

    before: Lens
    after: Lens
    sigma: Array
    sigmas: float

    def sentence(self) -> str:
        """In words."""
        a, b, (f, cx, cy, k1) = self.before, self.after, self.sigma.tolist()
        return (
            f"f {a.fx:.1f} -> {b.fx:.1f} ± {f * b.fx:.1f} px, centre {a.cx:.1f} -> {b.cx:.1f} ± {cx:.1f}, "
            f"{a.cy:.1f} -> {b.cy:.1f} ± {cy:.1f} px, k1 {_k1(a):.4f} -> {_k1(b):.4f} ± {k1:.4f}"
        )

    def as_dict(self) -> dict[str, Any]:
        """For the `calibration` map of `rig.yaml`: what it was before, and standard deviations now."""
        f, cx, cy, k1 = self.sigma.tolist()
        before = {"fx": self.before.fx, "fy": self.before.fy, "cx": self.before.cx, "cy": self.before.cy}
        sigma = {"fx": f * self.after.fx, "fy": f * self.after.fy, "cx": cx, "cy": cy, "k1": k1}
        return {
            "before": {**before, "k1": _k1(self.before)},
            "sigma": {name: round(value, 5) for name, value in sigma.items()},
            "sigmas": round(self.sigmas, 2),
        }


def find_changes(names: Sequence[str], adjusted: Adjusted) -> dict[str, LensChange]:
    """By camera."""
    covariance, changes = camera_covariance(adjusted).of(LENS), {}
    for k, (name, lens) in enumerate(zip(names, adjusted.problem.lenses, strict=True)):
        off, cov = adjusted.state.lenses[k], covariance[k, :, k]
        sigmas = float(np.sqrt(off @ np.linalg.solve(cov, off) / len(off)))
        changes[name] = LensChange(lens, adjusted.state.lens(k, lens), np.sqrt(np.diag(cov)), sigmas)
    return changes


def describe(changes: dict[str, LensChange]) -> list[str]:
    """What a person should know, line by line."""
    clear = {name: change for name, change in changes.items() if change.sigmas > CLEAR}
    lines = ["the wave corrects lenses: the rig that is written has them (before -> now)"] if clear else []
    lines += [f"lens of {name}: {change.sentence()}" for name, change in clear.items()]
    if rest := [name for name in changes if name not in clear]:
        lines.append(
            f"as they were, within {CLEAR:g} sigmas: the lens{'es' * (len(rest) > 1)} of {', '.join(rest)}"
        )
    return lines


def _k1(lens: Lens) -> float:
    return lens.distortion[0] if lens.distortion else 0.0
