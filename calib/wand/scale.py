# SPDX-License-Identifier: BSD-3-Clause
"""A rig's scale by the measured distance of two cameras: what gives it to a wand of one marker, and checks others."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import POSE
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.bundle_adjustment.optimizer import Adjusted
from calib.wand.bundle_adjustment.problem import gauge_directions

SIGMA_M = 0.005  # of a tape's reading from one lens to another: where in it the centre is, nobody sees
CLEAR = 3.0  # sigmas, beyond which measures contradict each other


@dataclass(frozen=True, slots=True)
class Distance:
    """Between the projection centres of two cameras, as somebody measured it: metres, and its standard deviation."""

    a: str
    b: str
    metres: float
    sigma_m: float = SIGMA_M

    @classmethod
    def of(
        cls, told: tuple[str, str, float] | None, sigma_m: float, names: Sequence[str]
    ) -> "Distance | None":
        """What the options of a command say, where they say something.

        Raises:
            CalibrationError: see `check`.
        """
        if told is None:
            return None
        distance = cls(*told, sigma_m)
        distance.check(names)
        return distance

    def check(self, names: Sequence[str]) -> None:
        """Raise CalibrationError where it is no distance of two of the rig's cameras."""
        if unknown := [name for name in (self.a, self.b) if name not in names]:
            raise CalibrationError(
                f"--distance names camera '{unknown[0]}', which is not in the rig; it has {', '.join(sorted(names))}"
            )
        if self.a == self.b:
            raise CalibrationError(f"--distance names camera '{self.a}' twice; it needs two cameras")
        if not 0 < self.metres < np.inf:
            raise CalibrationError(f"--distance is {self.metres:g} m; it must be above 0")
        if not 0 <= self.sigma_m < self.metres:
            raise CalibrationError(
                f"--distance-sigma is {self.sigma_m:g} m; it must be 0 or more, and below the distance"
            )

    def between(self, names: Sequence[str], unplaced: Mapping[str, str]) -> tuple[int, int, float]:
        """The numbers of the two cameras among those that are placed, and the distance.

        Raises:
            CalibrationError: one of them has no place.
        """
        if missing := [name for name in (self.a, self.b) if name not in names]:
            raise CalibrationError(
                f"the distance from '{self.a}' to '{self.b}' gives no scale, as camera '{missing[0]}' has no place: "
                f"{unplaced.get(missing[0], 'it is not in the recording')}"
            )
        return names.index(self.a), names.index(self.b), self.metres


@dataclass(frozen=True, slots=True)
class Comparison:
    """A measured distance beside what the wand gives: metres, and the standard deviation of the difference."""

    distance: Distance
    by_wand_m: float
    sigma_m: float

    @property
    def off_m(self) -> float:
        """The wand's less the measured one."""
        return self.by_wand_m - self.distance.metres

    def sentence(self) -> str:
        """How they agree, and what to do where they do not."""
        told, metres = self.distance, self.distance.metres
        said = (
            f"'{told.a}' and '{told.b}' are {self.by_wand_m:.4f} m apart by the wand, {metres:.4f} m as measured: "
            f"{1e3 * self.off_m / metres:+.2f} ± {1e3 * self.sigma_m / metres:.2f} per mille"
        )
        if abs(self.off_m) <= CLEAR * self.sigma_m:
            return said
        return f"warning: {said}; the wand's length gives the scale: measure it, and the distance, again"


def compare(distance: Distance, names: Sequence[str], adjusted: Adjusted) -> Comparison | None:
    """What the wand says of a measured distance; None where one of the cameras has no place."""
    if distance.a not in names or distance.b not in names:
        return None
    ends = [names.index(distance.a), names.index(distance.b)]
    first, second = adjusted.state.cameras[ends]
    gap = first[:3, 3] - second[:3, 3]
    long = float(np.linalg.norm(gap))
    along = np.concatenate([gap @ first[:3, :3], -gap @ second[:3, :3]]) / long
    cov = camera_covariance(adjusted).of(POSE)[np.ix_(ends, range(3, 6), ends, range(3, 6))].reshape(6, 6)
    return Comparison(distance, long, float(np.sqrt(along @ cov @ along + distance.sigma_m**2)))


def loosen(adjusted: Adjusted, distance: Distance) -> Adjusted:
    """The adjustment with the distance that carried its scale taken as uncertain: S + s^2 g g' for its covariance S,
    the cameras' change g with the world's scale, the choice of the world apart, and its relative deviation s, at the
    noise that observations claim; of the information, a downdate of rank one (Sherman and Morrison)."""
    relative = distance.sigma_m / distance.metres / (adjusted.scale * adjusted.inflation**0.5)
    if relative == 0:
        return adjusted
    free = adjusted.problem.free
    grown = np.zeros((len(adjusted.state.cameras), len(free)))
    grown[:, [free.index(p) for p in POSE[3:]]] = np.einsum(
        "cji,cj->ci", adjusted.state.cameras[:, :3, :3], adjusted.state.cameras[:, :3, 3]
    )
    gauge = np.linalg.qr(gauge_directions(adjusted.state, free))[0]
    change = grown.ravel() - gauge @ (gauge.T @ grown.ravel())
    pulled = adjusted.information @ change
    pulled -= gauge @ (gauge.T @ pulled)
    lost = np.outer(pulled, pulled) / (relative**-2 + change @ pulled)
    return replace(adjusted, information=adjusted.information - lost)
