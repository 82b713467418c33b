# SPDX-License-Identifier: BSD-3-Clause
"""The result of a wand calibration: the rig, its report, and the adjustment behind it."""

from dataclasses import dataclass
from typing import Any

from calib.rig.rig import Rig
from calib.wand.bundle_adjustment.optimizer import Adjusted
from calib.wand.bundle_adjustment.problem import WandObservations
from calib.wand.report import ClockJump, WandReport
from camera_node.foundation.arrays import Array


@dataclass(frozen=True, slots=True)
class WandCalibration:
    """The calibrated rig, its report, and the adjustment.

    Attributes:
        rig, report: the result.
        names: of the C placed cameras, the order of all below.
        adjusted: the adjustment; `observations` are its rows.
        covariance: (6C, 6C) of all poses together, each in its camera's own frame, rotation then translation; the gauge
            is the mean of the cameras.
        time_offset_ms, time_sigma_ms: (C,) true time = timestamp + offset in the middle of the recording, median 0; and
            standard deviations, 0 if the data need no offsets.
        drift_ppm, drift_sigma_ppm: (C,) growth of the offsets, microseconds per second, mean 0; and standard
            deviations.
        readout_ms, readout_sigma_ms: (C,) readout times of rolling shutters, and standard deviations, 0 where they are
            only given.
        jump: the clock jump during the recording, if there is one.
    """

    rig: Rig
    report: WandReport
    names: list[str]
    adjusted: Adjusted
    observations: WandObservations
    covariance: Array
    time_offset_ms: Array
    time_sigma_ms: Array
    drift_ppm: Array
    drift_sigma_ppm: Array
    readout_ms: Array
    readout_sigma_ms: Array
    jump: ClockJump | None

    @property
    def synchronous(self) -> bool:
        """Whether frames with equal stamps were taken as simultaneous."""
        return self.adjusted.problem.gap_s == 0

    def as_dict(self) -> dict[str, Any]:
        """Return the `calibration` map of `rig.yaml`: report, clocks if the data need them, and changes of lenses."""
        columns = {
            "time_offset_ms": (self.time_offset_ms, self.time_sigma_ms),
            "drift_ppm": (self.drift_ppm, self.drift_sigma_ppm),
            "readout_ms": (self.readout_ms, self.readout_sigma_ms),
        }
        clocks = {key: self._by_camera(*column) for key, column in columns.items() if (column[1] > 0).any()}
        jump = {"clock_jump": {self.jump.camera: self.jump.as_dict()}} if self.jump else {}
        return {**self.report.as_dict(), **clocks, **jump, "adjusted_lenses": self.report.adjusted_lenses}

    def _by_camera(self, values: Array, sigmas: Array) -> dict[str, dict[str, float]]:
        return {
            name: {"value": round(float(value), 4), "sigma": round(float(sigma), 4)}
            for name, value, sigma in zip(self.names, values, sigmas, strict=True)
        }
