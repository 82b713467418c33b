# SPDX-License-Identifier: BSD-3-Clause
"""The measured distance of two cameras: the scale for a wand of one marker, a check of any other wand."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.errors import CalibrationError
from calib.rig.estimation import CLEAR

SIGMA_M = 0.005  # of a tape measure between two lenses: the projection centres inside are not visible


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
