# SPDX-License-Identifier: BSD-3-Clause
"""The result of a wand calibration: the rig, the figures for users and for the `calibration` map of `rig.yaml`, and the
adjustment behind it.
"""

from collections import Counter
from dataclasses import dataclass
from typing import Any

from calib.rig.rig import Rig
from calib.wand.bundle_adjustment.problem import Adjusted, WandObservations
from calib.wand.scale import Distance, DistanceComparison
from camera_node.foundation.arrays import Array

NOT_RECORDED = "it is not in the recording"  # reason of a camera without detections messages


@dataclass(frozen=True, slots=True)
class CameraReport:
    """Figures of one placed camera.

    Attributes:
        frames, frames_used: frames with the wand, and those that the adjustment used.
        observations, outliers: marker centres used and rejected.
        residual_px: RMS distance of detected from expected centres.
        sigma_mm: expected error of the position along one axis.
        left_out: number of frames that were not used, by reason.
    """

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
    """A rejected marker centre: seconds after the first frame, and pixels from the expected centre."""

    camera: str
    t_s: float
    marker: int
    off_px: float


@dataclass(frozen=True, slots=True)
class Exchange:
    """A camera under whose name a part of the recording has the points of another camera.

    Attributes:
        shown: the camera whose name the detections have.
        of: the camera that made them.
        share: their part of all detections of `shown`.
    """

    shown: str
    of: str
    share: float


@dataclass(frozen=True, slots=True)
class ClockJump:
    """A jump of a camera's timestamps by `ms` with standard deviation `sigma_ms`, at `at_s`, seconds after the first
    frame of the recording; `or_moved` where the recording may as well show that the camera moved then."""

    camera: str
    ms: float
    sigma_ms: float
    at_s: float
    or_moved: bool = False

    def sentence(self) -> str:
        """State the jump and its remedy."""
        moved = ", or it moved then, which the recording does not tell apart" if self.or_moved else ""
        return (
            f"its clock jumps by {self.ms:+.1f} \N{PLUS-MINUS SIGN} {self.sigma_ms:.1f} ms at {self.at_s:.1f} "
            f"s{moved}: make sure that nothing sets it and that no frames are dropped, and wave the wand again"
        )

    def as_dict(self) -> dict[str, float]:
        """Return the entry for the `calibration` map of `rig.yaml`."""
        return {"ms": round(self.ms, 2), "sigma": round(self.sigma_ms, 2), "at_s": round(self.at_s, 2)}


@dataclass(frozen=True, slots=True)
class Validation:
    """Residuals of n detections at a rig.

    Attributes:
        count: n; detections that no other camera saw at once have no residual and do not count.
        all_px: RMS distance of detected from expected centres, over all n.
        gross: share of gross errors.
        residual_px: RMS distance without these.
        error_m: RMS distance of the markers from the viewing rays without these, in the unit of the rig.
        range_m: median distance of the markers from the cameras.
    """

    count: int
    all_px: float
    gross: float
    residual_px: float
    error_m: float
    range_m: float

    @property
    def relative(self) -> float:
        """The error as a part of the distance."""
        return self.error_m / self.range_m


@dataclass(frozen=True, slots=True)
class BackgroundReport:
    """Points beside the wand.

    Attributes:
        points: number of positions of points that were matched and located.
        images: number of their images.
        rejected: share of the images that contradict the rig.
        residual_px: RMS distance of the others from their points.
    """

    points: int
    images: int
    rejected: float
    residual_px: float

    def sentence(self) -> str:
        """State the figures."""
        return (
            f"{self.points} positions of background points in {self.images} images, {self.rejected:.1%} of these "
            f"rejected: residual {self.residual_px:.3f} px"
        )

    def as_dict(self) -> dict[str, float]:
        """Return the entry for the `calibration` map of `rig.yaml`."""
        return {
            "points": self.points,
            "images": self.images,
            "rejected": round(self.rejected, 4),
            "residual_px": round(self.residual_px, 4),
        }


@dataclass(frozen=True, slots=True)
class WandReport:
    """Figures of a wand calibration.

    Attributes:
        cameras: of the placed cameras.
        unplaced: the reason for each camera without a pose.
        wand_poses: number of estimated poses of the wand.
        length_mean_mm, length_std_mm: measured less nominal lengths of the wand; None with one marker.
        outliers: the rejected marker centres, worst first.
        given, held_out: residuals of all detections, and of held-out ones (`Validation`).
        metric: whether the scale is known.
        sigma_inflation: factor of the standard deviations for the correlation of residuals in time.
        scaled_by: the measured distance that gives the scale.
        compared: a measured distance compared with the wand.
        timing: whether the cameras are taken as synchronous, and why.
        wand: how the wand, as the cameras measure it, differs from its file; empty where it does not.
        size_sigma: standard deviation of the wand's size, relative, from errors of its file.
        adjusted_lenses: the change of each lens by the adjustment, as `rig.yaml` has it.
        exchanges: cameras under whose names there are points of others; these were left out.
        background: the points beside the wand, if any are given.
    """

    cameras: list[CameraReport]
    unplaced: dict[str, str]
    wand_poses: int
    length_mean_mm: float | None
    length_std_mm: float | None
    outliers: list[Outlier]
    given: Validation | None
    held_out: Validation | None
    metric: bool
    sigma_inflation: float
    scaled_by: Distance | None
    compared: DistanceComparison | None
    timing: str
    wand: str
    size_sigma: float
    adjusted_lenses: dict[str, Any]
    exchanges: list[Exchange]
    background: BackgroundReport | None = None

    @property
    def residual_px(self) -> float:
        """RMS distance of detected from expected centres, over all cameras."""
        total = sum(row.observations for row in self.cameras)
        return (sum(row.residual_px**2 * row.observations for row in self.cameras) / total) ** 0.5

    def left_out(self) -> Counter[str]:
        """Count the frames of placed cameras that were not used, by reason."""
        return sum((Counter(row.left_out) for row in self.cameras), Counter())

    def as_dict(self) -> dict[str, Any]:
        """Return the entries for the `calibration` map of `rig.yaml`."""
        return {
            "metric": self.metric,
            "timing": self.timing,
            **({"wand": self.wand} if self.wand else {}),
            "wand_poses": self.wand_poses,
            "residual_px": round(self.residual_px, 4),
            **self._validation(),
            "sigma_inflation": round(self.sigma_inflation, 2),
            "wand_length_error_mm": self._length_error(),
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
            **self._exchanged(),
            **({"background": self.background.as_dict()} if self.background else {}),
        }

    def _validation(self) -> dict[str, Any]:
        entries = {}
        if (given := self.given) is not None:
            entries["all_residual_px"] = round(given.all_px, 4)
            entries["gross_errors"] = round(given.gross, 4)
        if (held_out := self.held_out) is not None:
            unit = {"mm": round(1e3 * held_out.error_m, 3)} if self.metric else {}
            relative = {"per_mille_of_distance": round(1e3 * held_out.relative, 3)}
            entries["held_out"] = {"residual_px": round(held_out.residual_px, 4), **unit, **relative}
        return entries

    def _length_error(self) -> dict[str, float] | None:
        if self.length_mean_mm is None or self.length_std_mm is None:
            return None
        return {"mean": round(self.length_mean_mm, 3), "std": round(self.length_std_mm, 3)}

    def _exchanged(self) -> dict[str, Any]:
        if not self.exchanges:
            return {}
        rows = [{"camera": e.shown, "shows": e.of, "share": round(e.share, 4)} for e in self.exchanges]
        return {"exchanged_points": rows}

    def _distance(self) -> dict[str, Any]:
        compared = {"by_wand_m": round(self.compared.by_wand_m, 5)} if self.compared else {}
        if (distance := self.compared.distance if self.compared else self.scaled_by) is None:
            return {}
        measured = {
            "cameras": [distance.a, distance.b],
            "metres": distance.metres,
            "sigma_m": distance.sigma_m,
        }
        return {"distance": measured | compared}


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
