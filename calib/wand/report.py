# SPDX-License-Identifier: BSD-3-Clause
"""What a wand calibration says of itself, in figures; `rig.yaml` keeps them."""

from collections import Counter
from dataclasses import dataclass
from typing import Any

from calib.wand.scale import Comparison, Distance


@dataclass(frozen=True, slots=True)
class CameraReport:
    """One placed camera: frames with the wand, those used, marker centres used and rejected, the RMS distance of seen
    from expected centres, the expected error of its position along one axis, and why frames were left out."""

    name: str
    frames: int
    frames_used: int
    observations: int
    outliers: int
    residual_px: float
    sigma_mm: float
    left_out: dict[str, int]


@dataclass(frozen=True, slots=True)
class Outlier:
    """A marker centre that the statistics rejected: `t_s` after the first instant, `off_px` from where it should be."""

    camera: str
    t_s: float
    marker: int
    off_px: float


@dataclass(frozen=True, slots=True)
class WandReport:
    """What a wand calibration says of itself.

    `unplaced` holds the reason for each camera without a pose; `scale` is what residuals are over what the detector
    claimed; lengths are those that the cameras measure less the wand file's, None without two markers; `metric` is
    False where nothing gives the scale; standard deviations are `widened` times what independent errors would give. A
    measured distance of two cameras is what the rig is `scaled_by`, or `compared` with what the wand gives.
    """

    cameras: list[CameraReport]
    unplaced: dict[str, str]
    instants: int
    scale: float
    length_mean_mm: float | None
    length_std_mm: float | None
    outliers: list[Outlier]
    metric: bool
    widened: float = 1.0
    scaled_by: Distance | None = None
    compared: Comparison | None = None

    @property
    def residual_px(self) -> float:
        """RMS distance of seen from expected centres, over all cameras."""
        total = sum(row.observations for row in self.cameras)
        return (sum(row.residual_px**2 * row.observations for row in self.cameras) / total) ** 0.5

    def left_out(self) -> Counter[str]:
        """Frames of placed cameras that were not used, by reason."""
        return sum((Counter(row.left_out) for row in self.cameras), Counter())

    def as_dict(self) -> dict[str, Any]:
        """For the `calibration` map of `rig.yaml`."""
        return {
            "metric": self.metric,
            "instants": self.instants,
            "residual_px": round(self.residual_px, 4),
            "widened": round(self.widened, 2),
            "wand_length_error_mm": _figures(self.length_mean_mm, self.length_std_mm),
            **self._distance(),
            "cameras": {
                row.name: {
                    "frames": row.frames_used,
                    "observations": row.observations,
                    "outliers": row.outliers,
                    "residual_px": round(row.residual_px, 4),
                    "sigma_mm": round(row.sigma_mm, 3),
                }
                for row in self.cameras
            },
            "left_out": dict(self.left_out()),
            "unplaced": dict(self.unplaced),
        }

    def _distance(self) -> dict[str, Any]:
        if (told := self.scaled_by or (self.compared and self.compared.distance)) is None:
            return {}
        said = {"cameras": [told.a, told.b], "metres": told.metres, "sigma_m": told.sigma_m}
        return {
            "distance": said | ({"by_wand_m": round(self.compared.by_wand_m, 5)} if self.compared else {})
        }


def _figures(mean: float | None, std: float | None) -> dict[str, float] | None:
    return None if mean is None or std is None else {"mean": round(mean, 3), "std": round(std, 3)}
