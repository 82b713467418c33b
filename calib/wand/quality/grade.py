# SPDX-License-Identifier: BSD-3-Clause
"""How far a wand calibration can be trusted: by camera, by what each image was used for, and as a grade.

Every criterion is a figure with three limits; a camera's grade is that of its worst figure, the rig's that of its worst
camera or of the wand's length. What a figure means for the person who waved stands with it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.rig.camera import Camera, transform
from calib.rig.coverage import Coverage, cell_centres, enumerate_words
from calib.rig.precision_map import SIGMA_PX, FloorGrid, PrecisionMap, map_precision
from calib.rig.triangulation import JointCovariance
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.outcome import WandCalibration
from calib.wand.quality.blame import lens_to_blame, pose_px
from calib.wand.report import CameraReport
from camera_node.arrays import Array, Mask
from camera_node.geometry.body import Body
from camera_node.geometry.pose import invert

GRADES = "ABCD"
# A, B and C at most; beyond is D.
LIMITS = {
    "residual_px": (0.3, 0.7, 1.5),  # a good lens at rest; webcams that blur; wrong lenses begin
    "rejected": (0.05, 0.1, 0.25),  # part of the wand's markers
    "pose_px": (
        0.1,
        0.3,
        1.0,
    ),  # what the camera's own covariance moves a point by, beside 0.1 px of a roundel
    "unused": (0.5, 0.7, 0.85),  # part of the image that other cameras see too
    "length": (0.002, 0.005, 0.02),  # of the wand's length, off in the mean
}
ADVICE = {
    "residual_px": "calibrate its lens again, and compare its time stamps",
    "rejected": "look for reflections and other round things in its view",
    "pose_px": "wave longer where it and two other cameras see the wand",
    "length": "measure the wand, and calibrate the lenses again",
}
NOT_RECORDED = "is not in the recording"  # the reason of a camera that was not there, which is nobody's fault
CELLS = (4, 6)  # rows and columns in which an image is counted
MANY = 4  # thirds of an image: more are not worth naming
DEPTHS = (0.1, 0.5, 0.9)  # quantiles of the wand's distances, at which another camera may see too


@dataclass(frozen=True, slots=True)
class CameraQuality:
    """What there is to say of one placed camera.

    Attributes:
        coverage: the wand's used markers in cells of the image.
        useful: (rows, columns) cells in which another camera could see the wand too.
        figures: by criterion, of those in LIMITS that a camera has.
        lens: the camera whose lens spoils `pose_px` most; empty where lenses make up less than half of its square.
        noise_px: as `pose_px`, by the noise of what was seen alone: more of the same waving makes it smaller.
    """

    name: str
    coverage: Coverage
    useful: Mask
    figures: dict[str, float]
    lens: str = ""
    noise_px: float = 0.0

    @property
    def missing(self) -> Mask:
        """(rows, columns) useful cells through which the wand was not waved."""
        return self.useful & ~self.coverage.used

    @property
    def strain(self) -> float:
        """What the wave's noise moves a pixel by, over the pixel's own noise (0.1 px, or its residual)."""
        return self.noise_px / max(SIGMA_PX, self.figures["residual_px"] / np.sqrt(2))

    @property
    def grade(self) -> str:
        """A to D."""
        return max(grade(name, value) for name, value in self.figures.items())

    @property
    def worst(self) -> str:
        """The criterion that gives the grade: the one farthest beyond its limits."""
        return max(self.figures, key=lambda name: _strain(name, self.figures[name]))

    @property
    def advice(self) -> str:
        """What to do about the worst criterion."""
        if self.worst == "pose_px" and self.lens:
            return (
                f"the lens of '{self.lens}' is known too roughly: wave longer, or run python -m calib intrinsics "
                f"--camera {self.lens}"
            )
        return self.wave_next if self.worst == "unused" else ADVICE[self.worst]

    @property
    def wave_next(self) -> str:
        """Where to wave next, such as `wave in its upper left`; empty where nothing useful is missing."""
        missing = self.coverage.missing(self.useful)
        if len(missing) > MANY:
            return "wave through its whole image"
        return f"wave in its {enumerate_words(missing)}" if missing else ""


@dataclass(frozen=True, slots=True)
class RigQuality:
    """What a person needs to know before relying on a rig.

    Attributes:
        cameras: placed ones.
        unplaced: why, and what to do, by name of those that could not be placed.
        length: how far the wand's length is off in the mean, as a part of it; None without two markers.
        expected: errors of points across the waved arena, at robots' height; None where the rig knows no metres.
    """

    cameras: list[CameraQuality]
    unplaced: dict[str, str]
    length: float | None
    expected: PrecisionMap | None

    @property
    def grade(self) -> str:
        """A to D: that of the worst camera, or of the wand's length."""
        grades = [camera.grade for camera in self.cameras] + ["D"] * bool(self.unplaced)
        return max(grades + ([grade("length", self.length)] if self.length is not None else []))

    def sentence(self) -> str:
        """The grade, whose fault it is, and what to do."""
        worst = max(self.cameras, key=lambda camera: _strain(camera.worst, camera.figures[camera.worst]))
        if self.unplaced:
            told = "; ".join(f"camera '{name}' has no place: {why}" for name, why in self.unplaced.items())
            return f"grade D: {told}"
        if self.length is not None and grade("length", self.length) == self.grade > worst.grade:
            return f"grade {self.grade}: the wand's length is {self.length:.2%} off; {ADVICE['length']}"
        if self.grade == "A":
            return "grade A: every camera is placed well"
        said = _describe(worst.worst, worst.figures[worst.worst])
        return f"grade {self.grade}: camera '{worst.name}', {said}" + (
            f"; {worst.advice}" if worst.advice else ""
        )

    def spoilt(self) -> list[str]:
        """Which lenses keep cameras from being placed better, line by line."""
        blamed: dict[str, list[str]] = {}
        for camera in self.cameras:
            if camera.lens and grade("pose_px", camera.figures["pose_px"]) > "A":
                blamed.setdefault(camera.lens, []).append(camera.name)
        return [
            f"warning: the lens of {lens} is known too roughly, and so is the place of {enumerate_words(names)}: wave "
            f"longer, or run python -m calib intrinsics --camera {lens}"
            for lens, names in blamed.items()
        ]

    def as_dict(self) -> dict[str, Any]:
        """For the `calibration` map of `rig.yaml`."""
        expected = {}
        if self.expected is not None and np.isfinite(self.expected.typical_mm):
            figures = {
                "median": self.expected.typical_mm,
                "worst": self.expected.worst_mm,
                "height": self.expected.grid.z,
            }
            expected = {"expected_mm": {name: round(value, 3) for name, value in figures.items()}}
        return {
            "grade": self.grade,
            "because": self.sentence(),
            **expected,
            "trust": {
                camera.name: {
                    "grade": camera.grade,
                    **{name: round(value, 4) for name, value in camera.figures.items()},
                    **({"next": camera.wave_next} if camera.wave_next else {}),
                }
                for camera in self.cameras
            },
        }


def grade(criterion: str, value: float) -> str:
    """A to D by the limits; NaN is D."""
    return next((g for g, limit in zip(GRADES, LIMITS[criterion], strict=False) if value <= limit), "D")


def _strain(criterion: str, value: float) -> float:
    """A figure over its limit for B: comparable between criteria of the same grade, and D after C after B."""
    position = GRADES.index(grade(criterion, value))
    return position + min(value / LIMITS[criterion][-1], 1.0) / 2 if np.isfinite(value) else len(GRADES)


def _describe(criterion: str, value: float) -> str:
    said = {
        "residual_px": f"residual {value:.2f} px",
        "rejected": f"{value:.0%} of its markers rejected",
        "pose_px": f"its place is known to {value:.2f} px only",
        "unused": f"{value:.0%} of what it could share with others was not waved through",
    }
    return said[criterion]


def assess(
    result: WandCalibration, wand: Body, height_m: float = 0.1, sigma_px: float = SIGMA_PX
) -> RigQuality:
    """Judge a calibration.

    Args:
        result: of `calib.wand.calibrate.calibrate`.
        wand: the wand of it.
        height_m: at which robots carry their roundels.
        sigma_px: standard deviation of a roundel's centre when robots are tracked.
    """
    wave = waved_points(result)
    rows = {row.name: row for row in result.report.cameras}
    covariance = camera_covariance(result.adjusted)
    noise, joint = covariance.noise, covariance.joint
    cameras = [
        _assess_camera(result, k, rows[name], wave, noise, joint) for k, name in enumerate(result.names)
    ]
    length, extent = result.report.length_mean_mm, np.linalg.norm(np.ptp(wand.points, axis=0))
    expected = None
    if result.report.metric:
        low, high = np.quantile(wave[:, :2], [0.02, 0.98], axis=0)
        placed = [result.rig.cameras[name] for name in result.names]
        size = joint.shape[0] * joint.shape[1]
        doubt = JointCovariance(result.adjusted.problem.free, joint.reshape(size, size))
        expected = map_precision(placed, FloorGrid.covering(low, high, height_m), sigma_px, doubt)
    off = None if length is None or extent == 0 else abs(length) / 1e3 / float(extent)
    unplaced = {name: why for name, why in sorted(result.report.unplaced.items()) if why != NOT_RECORDED}
    return RigQuality(cameras, unplaced, off, expected)


def waved_points(result: WandCalibration) -> Array:
    """(N, 3) where the wand has been, in the rig's world."""
    T_world_adjusted = result.rig.cameras[result.names[0]].matrix() @ invert(result.adjusted.state.cameras[0])
    return transform(T_world_adjusted, result.adjusted.state.motion[:, 0].reshape(-1, 3))


def _assess_camera(
    result: WandCalibration, k: int, row: CameraReport, wave: Array, noise: Array, joint: Array
) -> CameraQuality:
    """Camera k, by covariances (C, d, C, d) of all cameras: by the wave's noise alone, and by all that is unknown."""
    camera = result.rig.cameras[row.name]
    seen = result.observations
    uv = seen.uv[(seen.camera == k) & result.adjusted.used]
    coverage = Coverage.of(uv, camera.width, camera.height, CELLS)
    distances = np.linalg.norm(wave - camera.matrix()[:3, 3], axis=1)
    others = [result.rig.cameras[name] for name in result.names if name != row.name]
    useful = shared_cells(camera, others, np.quantile(distances, DEPTHS))
    distance = float(np.median(distances))
    figures = {
        "residual_px": row.residual_px,
        "rejected": row.outliers / max(row.outliers + row.observations, 1),
        "pose_px": pose_px(result, k, uv, distance, joint),
        "unused": 1 - coverage.share(useful),
    }
    lens = lens_to_blame(result, k, uv, distance, joint)
    noise_px = pose_px(result, k, uv, distance, noise)
    return CameraQuality(row.name, coverage, useful, figures, lens, noise_px)


def shared_cells(camera: Camera, others: list[Camera], distances: Array) -> Mask:
    """(rows, columns) the cells of a camera's image in which, at one of these distances, another camera sees too."""
    rays = camera.rays(cell_centres(camera.width, camera.height, CELLS))
    shared = np.zeros(len(rays), bool)
    for distance in distances:
        points = transform(camera.matrix(), rays * distance)
        for other in others:
            shared |= other.sees(other.project_world(points))
    return shared.reshape(CELLS)
