# SPDX-License-Identifier: BSD-3-Clause
"""Grades a wand calibration, camera by camera and as a whole, and advises what to improve.

Each criterion is a figure with three limits. The grade of a camera is that of its worst figure. The grade of the rig is
that of its error on held-out detections, or one worse where a camera or the wand's length is worse: what held-out
detections show to be precise is not graded as useless.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calib.rig.camera import LENS, Camera, transform
from calib.rig.coverage import Coverage, cell_centres, enumerate_words
from calib.rig.precision_map import SIGMA_PX, FloorGrid, PrecisionMap, map_precision
from calib.rig.triangulation import JointCovariance, camera_jacobians
from calib.wand.bundle_adjustment.covariance import CameraCovariance, camera_covariance
from calib.wand.bundle_adjustment.problem import scale_direction
from calib.wand.quality.lenses import describe_open_lenses, find_lens_changes, find_open_lenses
from calib.wand.wand_report import NOT_RECORDED, Validation, WandCalibration
from camera_node.foundation.arrays import Array, Mask
from camera_node.geometry.body import Body
from camera_node.geometry.pose import invert

GRADES = "ABCD"
# Largest value for A, B and C; a larger one is D.
LIMITS = {
    # Of sharp images and a good lens; of webcams with motion blur; of wrong intrinsics.
    "residual_px": (0.3, 0.7, 1.5),
    "rejected": (0.05, 0.1, 0.25),  # part of the marker centres
    "pose_px": (
        0.1,
        0.3,
        1.0,
    ),  # image error by the camera's own covariance; the noise of a roundel is 0.1 px
    "unused": (0.5, 0.7, 0.85),  # part of the image area shared with other cameras
    "length": (0.002, 0.005, 0.02),  # relative mean error of the wand's length
    "held_out": (5e-4, 1e-3, 3e-3),  # distance of held-out markers from the viewing rays, of their distance
}
ADVICE = {
    "residual_px": "calibrate its lens again, and check its timestamps",
    "rejected": "look for reflections and other round objects in its view",
    "pose_px": "wave the wand longer where it and two other cameras see it",
    "length": "measure the wand, and calibrate the lenses again",
}
MAX_REGIONS = 4  # ninths of an image that advice names; more are the whole image
CELLS = (4, 6)  # rows and columns of the grid for the coverage of an image
DEPTHS = (0.1, 0.5, 0.9)  # quantiles of the wand's distance, at which the shared image area is computed


@dataclass(frozen=True, slots=True)
class CameraQuality:
    """Figures of one placed camera.

    Attributes:
        coverage: used marker centres by cell of the image.
        shared: (rows, columns) cells in which another camera could see the wand too.
        figures: by criterion, of those in LIMITS that a camera has.
        limiting_lens: the camera whose lens contributes most to `pose_px`; empty if all lenses together contribute less
            than half of its variance.
        noise_px: `pose_px` by the image noise alone, which a longer recording reduces.
    """

    name: str
    coverage: Coverage
    shared: Mask
    figures: dict[str, float]
    limiting_lens: str = ""
    noise_px: float = 0.0

    @property
    def missing(self) -> Mask:
        """(rows, columns) shared cells without a used marker."""
        return self.shared & ~self.coverage.used

    @property
    def noise_ratio(self) -> float:
        """`noise_px` over the noise of a pixel: 0.1 px, or the residual if that is larger."""
        return self.noise_px / max(SIGMA_PX, self.figures["residual_px"] / np.sqrt(2))

    @property
    def grade(self) -> str:
        """A to D."""
        return max(grade(name, value) for name, value in self.figures.items())

    @property
    def worst(self) -> str:
        """The criterion that gives the grade: the one farthest beyond its limits."""
        return max(self.figures, key=lambda name: _severity(name, self.figures[name]))

    @property
    def advice(self) -> str:
        """How to improve the worst criterion."""
        if self.worst == "pose_px" and self.limiting_lens:
            return _advise_lens(f"the lens of '{self.limiting_lens}' is", self.limiting_lens)
        return self.wave_next if self.worst == "unused" else ADVICE[self.worst]

    @property
    def wave_next(self) -> str:
        """Where to wave the wand next, such as `wave in its upper left`; empty if no shared cell is missing."""
        regions = self.coverage.missing(self.shared)
        if len(regions) > MAX_REGIONS:
            return "wave through its whole image"
        return f"wave in its {enumerate_words(regions)}" if regions else ""


@dataclass(frozen=True, slots=True)
class RigQuality:
    """Quality of a calibrated rig.

    Attributes:
        cameras: the placed ones.
        unplaced: reason and remedy, by name of each recorded camera that could not be placed.
        length_error: relative mean error of the wand's length; None with one marker.
        expected: predicted errors of points at the height of robots' roundels; None for a rig without scale.
        held_out: residuals of held-out detections; None where they could not be measured.
        open_lenses: 95 % interval of each focal length that the recording does not determine, pixels, by camera.
        wand: how the wand differs from its file, with what to do; empty where it does not.
        size_sigma: standard deviation of the size of the wand, and so of the rig, relative.
    """

    cameras: list[CameraQuality]
    unplaced: dict[str, str]
    length_error: float | None
    expected: PrecisionMap | None
    held_out: Validation | None = None
    open_lenses: dict[str, tuple[float, float]] = field(default_factory=dict)
    wand: str = ""
    size_sigma: float = 0.0

    @property
    def grade(self) -> str:
        """A to D: by held-out detections, at most one grade worse for the worst camera or the wand's length or size; D
        where a camera is not placed."""
        grades = [camera.grade for camera in self.cameras] + [grade("length", self.size_sigma)]
        worst = max(grades + ([grade("length", self.length_error)] if self.length_error is not None else []))
        if self.unplaced:
            return "D"
        if self.held_out is None:
            return worst
        shown = grade("held_out", self.held_out.relative)
        return max(shown, min(worst, GRADES[min(GRADES.index(shown) + 1, len(GRADES) - 1)]))

    def sentence(self) -> str:
        """State the grade, its cause and the remedy, and what is not determined."""
        parts = (self._reason(), describe_open_lenses(self.open_lenses), self.wand)
        return "; ".join(part for part in parts if part)

    def _reason(self) -> str:
        worst = max(self.cameras, key=lambda camera: _severity(camera.worst, camera.figures[camera.worst]))
        if self.unplaced:
            reasons = "; ".join(
                f"camera '{name}' is not placed: {why}" for name, why in self.unplaced.items()
            )
            return f"grade D: {reasons}"
        start = f"grade {self.grade}: {self._measured()}"
        if self.length_error is not None and grade("length", self.length_error) > max("A", worst.grade):
            return f"{start}the wand's length is {self.length_error:.2%} off; {ADVICE['length']}"
        if grade("length", self.size_sigma) > max("A", worst.grade):
            advice = "" if self.wand else "; measure it again"
            return f"{start}the wand's size is known to {self.size_sigma:.1%} only{advice}"
        if worst.grade == "A":
            return f"{start}all cameras meet the limits"
        cause = _describe(worst.worst, worst.figures[worst.worst])
        advice = f"; to improve it: {worst.advice}" if worst.advice else ""
        return f"{start}camera '{worst.name}', {cause}{advice}"

    def _measured(self) -> str:
        """The error on held-out detections, in millimetres where the scale is known."""
        if self.held_out is None:
            return ""
        if self.expected is None:
            return f"held-out error {1e3 * self.held_out.relative:.2f} per mille of the distance; "
        return f"held-out error {1e3 * self.held_out.error_m:.2f} mm at {self.held_out.range_m:.1f} m; "

    def lens_warnings(self) -> list[str]:
        """List the lenses whose uncertainty limits the poses of cameras, one line each."""
        limited: dict[str, list[str]] = {}
        for camera in self.cameras:
            if camera.limiting_lens and grade("pose_px", camera.figures["pose_px"]) > "A":
                limited.setdefault(camera.limiting_lens, []).append(camera.name)
        return [
            "warning: "
            + _advise_lens(f"the lens of {lens}, and with it the pose of {enumerate_words(names)}, is", lens)
            for lens, names in limited.items()
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return the entries for the `calibration` map of `rig.yaml`."""
        cameras = {
            camera.name: {
                "grade": camera.grade,
                **{name: round(value, 4) for name, value in camera.figures.items()},
                **({"next": camera.wave_next} if camera.wave_next else {}),
            }
            for camera in self.cameras
        }
        entries = {"grade": self.grade, "because": self.sentence(), **self._expected(), "quality": cameras}
        ranges = {name: [round(low, 1), round(high, 1)] for name, (low, high) in self.open_lenses.items()}
        return {**entries, **({"focal_px_between": ranges} if ranges else {})}

    def _expected(self) -> dict[str, Any]:
        if self.expected is None or not np.isfinite(self.expected.typical_mm):
            return {}
        values = self.expected.typical_mm, self.expected.worst_mm, self.expected.grid.z
        return {
            "expected_mm": dict(
                zip(("median", "worst", "height"), (round(v, 3) for v in values), strict=True)
            )
        }


def grade(criterion: str, value: float) -> str:
    """Return A to D by the limits; NaN is D."""
    return next((g for g, limit in zip(GRADES, LIMITS[criterion], strict=False) if value <= limit), "D")


def _severity(criterion: str, value: float) -> float:
    """Return the grade as a number, plus the figure relative to its limit for C: comparable between criteria."""
    position = GRADES.index(grade(criterion, value))
    return position + min(value / LIMITS[criterion][-1], 1.0) / 2 if np.isfinite(value) else len(GRADES)


def _describe(criterion: str, value: float) -> str:
    texts = {
        "residual_px": f"residual {value:.2f} px",
        "rejected": f"{value:.0%} of its markers rejected",
        "pose_px": f"uncertainty of its pose {value:.2f} px",
        "unused": f"{value:.0%} of the image area that it shares with others unused",
    }
    return texts[criterion]


def _advise_lens(subject: str, name: str) -> str:
    return f"{subject} too uncertain: wave longer, or run roundel calibrate intrinsics --camera {name}"


def assess(result: WandCalibration, wand: Body, height_m: float = 0.1) -> RigQuality:
    """Grade a calibration.

    Args:
        result: of `calib.wand.calibrate.calibrate`.
        wand: that of the recording.
        height_m: height of the robots' roundels.
    """
    positions = wand_positions(result)
    covariance = camera_covariance(result.adjusted)
    by_size = result.report.size_sigma * scale_direction(result.adjusted.problem, result.adjusted.state)
    by_size = by_size.reshape(len(result.names), -1)
    cameras = [_assess_camera(result, k, positions, covariance, by_size[k]) for k in range(len(result.names))]
    length_mm, extent = result.report.length_mean_mm, np.linalg.norm(np.ptp(wand.points, axis=0))
    error = None if length_mm is None or extent == 0 else abs(length_mm) / 1e3 / float(extent)
    unplaced = {name: why for name, why in sorted(result.report.unplaced.items()) if why != NOT_RECORDED}
    expected = _predict(result, positions, covariance, height_m) if result.report.metric else None
    open_lenses = find_open_lenses(find_lens_changes(result.names, result.adjusted))
    differs = result.report.wand and (
        f"{result.report.wand}; this was used: measure both again, and correct the wand file"
    )
    return RigQuality(
        cameras,
        unplaced,
        error,
        expected,
        result.report.held_out,
        open_lenses,
        differs,
        result.report.size_sigma,
    )


def wand_positions(result: WandCalibration) -> Array:
    """Return (N, 3) positions of the wand's basis markers, in the rig's world."""
    T_world_adjusted = result.rig.cameras[result.names[0]].matrix() @ invert(result.adjusted.state.cameras[0])
    return transform(T_world_adjusted, result.adjusted.state.motion[:, 0].reshape(-1, 3))


def _predict(
    result: WandCalibration, positions: Array, covariance: CameraCovariance, height_m: float
) -> PrecisionMap:
    """Predict the errors of points across the area where the wand was."""
    size = len(covariance.joint) * len(covariance.free)
    low, high = np.quantile(positions[:, :2], [0.02, 0.98], axis=0)
    cameras = [result.rig.cameras[name] for name in result.names]
    joint = JointCovariance(covariance.free, covariance.joint.reshape(size, size))
    return map_precision(cameras, FloorGrid.covering(low, high, height_m), SIGMA_PX, joint)


def _assess_camera(
    result: WandCalibration, k: int, positions: Array, covariance: CameraCovariance, by_size: Array
) -> CameraQuality:
    """Grade camera k, whose free parameters change by `by_size` (d,) with the standard deviation of the wand's size:
    no longer recording would make that smaller."""
    row, joint, free = result.report.cameras[k], covariance.joint, covariance.free
    camera = result.rig.cameras[row.name]
    uv = result.observations.uv[(result.observations.camera == k) & result.adjusted.used]
    coverage = Coverage.of(uv, camera.width, camera.height, CELLS)
    distances = np.linalg.norm(positions - camera.matrix()[:3, 3], axis=1)
    others = [result.rig.cameras[name] for name in result.names if name != row.name]
    shared = shared_cells(camera, others, np.quantile(distances, DEPTHS))
    rays = camera.rays(uv)
    points = rays[np.isfinite(rays).all(axis=1)] * float(np.median(distances))
    J = camera_jacobians(camera, points, free)
    figures = {
        "residual_px": row.residual_px,
        "rejected": row.outliers / max(row.outliers + row.observations, 1),
        "pose_px": _rms_px(J, joint[k, :, k] - np.outer(by_size, by_size)),
        "unused": 1 - coverage.share(shared),
    }
    lens = find_limiting_lens(J, joint, k, [free.index(p) for p in LENS])
    name = "" if lens is None else result.names[lens]
    noise_px = _rms_px(J, covariance.noise[k, :, k] - np.outer(by_size, by_size))
    return CameraQuality(row.name, coverage, shared, figures, name, noise_px)


def _rms_px(J: Array, covariance: Array) -> float:
    """Return the RMS image error per coordinate of points with Jacobians (n, 2, d), for a covariance (d, d)."""
    if not len(J):
        return float("nan")
    return float(np.sqrt(max(np.einsum("nii->n", J @ covariance @ np.swapaxes(J, 1, 2)).mean() / 2, 0.0)))


def find_limiting_lens(J: Array, joint: Array, k: int, lens: list[int]) -> int | None:
    """Return the camera whose lens, if known, would reduce the image errors of camera k most.

    Args:
        J: (n, 2, d) Jacobians of points in the image of camera k.
        joint: (C, d, C, d) covariance of all cameras.
        lens: columns of the lens parameters.

    Returns:
        its index; None if all lenses together would not halve the variance.
    """
    cov_lenses = joint[:, lens][:, :, :, lens]
    cross = np.einsum("nip,pcl->nicl", J, joint[k][:, :, lens])
    single = [_explained(cross[:, :, c], cov_lenses[c, :, c]) for c in range(len(cov_lenses))]
    size = len(lens) * len(single)
    together = _explained(cross.reshape(*J.shape[:2], -1), cov_lenses.reshape(size, size))
    total = float(np.einsum("nip,pq,niq->", J, joint[k, :, k], J))
    return int(np.argmax(single)) if together > total / 2 else None


def _explained(cross: Array, covariance: Array) -> float:
    """Return the variance, summed over pixels, that knowing parameters would remove, from their covariance (l, l) and
    the covariances `cross` (n, 2, l) of the pixels with them."""
    unit = np.sqrt(np.diag(covariance))
    scaled = cross / unit
    return float(np.einsum("nip,pq,niq->", scaled, np.linalg.inv(covariance / np.outer(unit, unit)), scaled))


def shared_cells(camera: Camera, others: list[Camera], distances: Array) -> Mask:
    """Return (rows, columns) the image cells whose points at one of the distances another camera sees too."""
    rays = camera.rays(cell_centres(camera.width, camera.height, CELLS))
    shared = np.zeros(len(rays), bool)
    for distance in distances:
        points = transform(camera.matrix(), rays * distance)
        for other in others:
            shared |= other.sees(other.project_world(points))
    return shared.reshape(CELLS)
