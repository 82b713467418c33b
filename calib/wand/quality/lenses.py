# SPDX-License-Identifier: BSD-3-Clause
"""Compares the lenses of an adjustment with those of the rig file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.rig.camera import LENS, lens_parameters
from calib.rig.estimation import CLEAR
from calib.wand.bundle_adjustment.covariance import FOCAL, camera_covariance
from calib.wand.bundle_adjustment.problem import Adjusted
from camera_node.foundation.arrays import Array
from camera_node.geometry.lens import Lens

CHANGED = 2.0  # sigmas, root mean square of the parameters, above which a lens is reported as changed
HIGHER = {"pinhole": ("fx / fy", "k2", "p1", "p2", "k3"), "fisheye": ("fx / fy", "k2", "k3", "k4")}


@dataclass(frozen=True, slots=True)
class LensChange:
    """A lens before and after the adjustment.

    Attributes:
        before, after: the lens.
        sigma: (9,) standard deviations of its parameters (`LENS`) after it.
        sigmas: the change in these, root mean square.
    """

    before: Lens
    after: Lens
    sigma: Array
    sigmas: float

    @property
    def focal_range_px(self) -> tuple[float, float] | None:
        """The 95 % interval of a focal length that is not known better than by a data sheet; None of others."""
        if self.sigma[0] <= FOCAL:
            return None
        low, high = self.after.fx * np.exp(np.array([-1.96, 1.96]) * self.sigma[0])
        return float(low), float(high)

    def sentence(self) -> str:
        """The change in words."""
        a, b, (f, cx, cy, k1, *_) = self.before, self.after, self.sigma.tolist()
        return (
            f"f {a.fx:.1f} -> {b.fx:.1f} ± {f * b.fx:.1f} px, centre {a.cx:.1f} -> {b.cx:.1f} ± {cx:.1f}, "
            f"{a.cy:.1f} -> {b.cy:.1f} ± {cy:.1f} px, k1 {_k1(a):.4f} -> {_k1(b):.4f} ± {k1:.4f}"
            + "".join(
                f", {name} {was:.4f} -> {now:.4f} ± {sigma:.4f}" for name, was, now, sigma in self._higher()
            )
        )

    def _higher(self) -> list[tuple[str, float, float, float]]:
        """The other parameters that changed clearly: name, before, after and standard deviation."""
        names = HIGHER[self.before.model]  # a fisheye has one parameter less
        columns = zip(names, _shape(self.before), _shape(self.after), self.sigma[4:], strict=False)
        return [row for row in columns if abs(row[2] - row[1]) > CLEAR * row[3]]

    def as_dict(self) -> dict[str, Any]:
        """The values before, and standard deviations after, for the `calibration` map of `rig.yaml`."""
        f, cx, cy, k1, *higher = self.sigma.tolist()
        names = HIGHER[self.before.model]
        before = {"fx": self.before.fx, "fy": self.before.fy, "cx": self.before.cx, "cy": self.before.cy}
        sigma = {"fx": f * self.after.fx, "fy": f * self.after.fy, "cx": cx, "cy": cy, "k1": k1}
        sigma |= dict(zip(names, higher, strict=False))
        return {
            "before": {**before, "k1": _k1(self.before)}
            | dict(zip(names, _shape(self.before), strict=False)),
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


def find_open_lenses(changes: Mapping[str, LensChange]) -> dict[str, tuple[float, float]]:
    """The range, pixels, of each focal length that the recording does not determine, by camera."""
    return {name: found for name, change in changes.items() if (found := change.focal_range_px) is not None}


def describe_open_lenses(ranges: Mapping[str, tuple[float, float]]) -> str:
    """What is not determined, and the remedy; empty where every focal length is."""
    if not ranges:
        return ""
    which = ", ".join(
        f"of '{name}' between {low:.0f} and {high:.0f} px" for name, (low, high) in ranges.items()
    )
    return (
        f"focal lengths are not determined: {which}; move the wand towards the cameras and away from them, and where "
        "more cameras see it, use a wand of two markers or more, or run roundel calibrate intrinsics"
    )


def describe_lens_changes(changes: dict[str, LensChange]) -> list[str]:
    """The significant changes for the user, line by line."""
    clear = {name: change for name, change in changes.items() if change.sigmas > CHANGED}
    lines = (
        ["the recording corrects lenses; the written rig has the new values (before -> after)"]
        if clear
        else []
    )
    lines += [f"lens of {name}: {change.sentence()}" for name, change in clear.items()]
    if rest := [name for name in changes if name not in clear]:
        lines.append(
            f"unchanged within {CHANGED:g} sigmas: the lens{'es' * (len(rest) > 1)} of {', '.join(rest)}"
        )
    return lines


def _k1(lens: Lens) -> float:
    return lens.distortion[0] if lens.distortion else 0.0


def _shape(lens: Lens) -> list[float]:
    """The parameters of a lens after k1: fx / fy, and the distortion coefficients after k1."""
    log_ratio, *higher = lens_parameters(lens)[4:].tolist()
    return [float(np.exp(log_ratio)), *higher]
