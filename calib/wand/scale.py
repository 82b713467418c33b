# SPDX-License-Identifier: BSD-3-Clause
"""The measured distance of two cameras: the scale for a wand of one marker, a check of any other wand."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibrationError
from calib.rig.camera import POSE
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.bundle_adjustment.optimizer import Adjusted
from calib.wand.bundle_adjustment.problem import gauge_directions

SIGMA_M = 0.005  # of a tape measure between two lenses: the projection centres inside are not visible
CLEAR = 3.0  # standard deviations, beyond which two lengths contradict each other


@dataclass(frozen=True, slots=True)
class Distance:
    """Measured distance between the projection centres of two cameras, metres, and its standard deviation."""

    a: str
    b: str
    metres: float
    sigma_m: float = SIGMA_M

    @classmethod
    def of(
        cls, option: tuple[str, str, float] | None, sigma_m: float, names: Sequence[str]
    ) -> "Distance | None":
        """Read the options `--distance` and `--distance-sigma`; None without the first.

        Raises:
            CalibrationError: see `check`.
        """
        if option is None:
            return None
        distance = cls(*option, sigma_m)
        distance.check(names)
        return distance

    def check(self, names: Sequence[str]) -> None:
        """Raise CalibrationError if this is not a distance between two of the cameras `names`."""
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
        """Return the indices of the two cameras among `names`, and the distance.

        Args:
            names: of the placed cameras.
            unplaced: reasons by name of the others.

        Raises:
            CalibrationError: one of the two is not placed.
        """
        if missing := [name for name in (self.a, self.b) if name not in names]:
            raise CalibrationError(
                f"the distance from '{self.a}' to '{self.b}' gives no scale, because camera '{missing[0]}' could not "
                f"be placed: {unplaced.get(missing[0], 'it is not in the recording')}"
            )
        return names.index(self.a), names.index(self.b), self.metres


@dataclass(frozen=True, slots=True)
class DistanceComparison:
    """A measured distance and the same distance by the wand, metres; `sigma_m` is that of their difference."""

    distance: Distance
    by_wand_m: float
    sigma_m: float

    @property
    def difference_m(self) -> float:
        """The distance by the wand less the measured one."""
        return self.by_wand_m - self.distance.metres

    def sentence(self) -> str:
        """State how they agree; if they do not, a warning with the remedy."""
        a, b, metres = self.distance.a, self.distance.b, self.distance.metres
        text = (
            f"distance of '{a}' and '{b}': {self.by_wand_m:.4f} m by the wand, {metres:.4f} m measured, difference "
            f"{1e3 * self.difference_m / metres:+.2f} ± {1e3 * self.sigma_m / metres:.2f} per mille"
        )
        if abs(self.difference_m) <= CLEAR * self.sigma_m:
            return text
        return f"warning: {text}; measure the wand, whose length gives the scale, and the distance again"


def compare_distance(
    distance: Distance, names: Sequence[str], adjusted: Adjusted
) -> DistanceComparison | None:
    """Compare a measured distance with the adjusted poses; None if one of the two cameras is not placed.

    Args:
        distance: the measured one.
        names: of the adjusted cameras.
        adjusted: the adjustment.
    """
    if distance.a not in names or distance.b not in names:
        return None
    ends = [names.index(distance.a), names.index(distance.b)]
    first, second = adjusted.state.cameras[ends]
    gap = first[:3, 3] - second[:3, 3]
    length = float(np.linalg.norm(gap))
    J = np.concatenate([gap @ first[:3, :3], -gap @ second[:3, :3]]) / length
    cov = camera_covariance(adjusted).of(POSE)[np.ix_(ends, range(3, 6), ends, range(3, 6))].reshape(6, 6)
    return DistanceComparison(distance, length, float(np.sqrt(J @ cov @ J + distance.sigma_m**2)))


def add_scale_uncertainty(adjusted: Adjusted, distance: Distance) -> Adjusted:
    """Add the uncertainty of the distance that gave the scale, which the adjustment took as exact.

    The covariance S becomes S + s^2 g g', for the relative standard deviation s of the distance and the derivative g of
    the cameras by the scale of the world, without its component along the gauge. In the information matrix this is a
    downdate of rank one (Sherman and Morrison).
    """
    relative = distance.sigma_m / distance.metres / (adjusted.scale * adjusted.inflation**0.5)
    if relative == 0:
        return adjusted
    free, cameras = adjusted.problem.free, adjusted.state.cameras
    by_scale = np.zeros((len(cameras), len(free)))
    translations = [free.index(p) for p in POSE[3:]]
    by_scale[:, translations] = np.einsum("cji,cj->ci", cameras[:, :3, :3], cameras[:, :3, 3])
    gauge = np.linalg.qr(gauge_directions(adjusted.state, free))[0]
    g = by_scale.ravel() - gauge @ (gauge.T @ by_scale.ravel())
    weighted = adjusted.information @ g
    weighted -= gauge @ (gauge.T @ weighted)
    lost = np.outer(weighted, weighted) / (relative**-2 + g @ weighted)
    return replace(adjusted, information=adjusted.information - lost)
