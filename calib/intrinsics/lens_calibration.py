# SPDX-License-Identifier: BSD-3-Clause
"""Calibrates a lens from views of a board (Zhang 2000): selects views, rejects outliers, checks the result, and states
its projection uncertainty and its weaknesses."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import msgspec
import numpy as np

from calib.errors import CalibrationError
from calib.intrinsics.board import BoardFinder, CharucoFinder
from calib.intrinsics.lens_adjustment import (
    ANY_SIGMA,
    AdjustedLens,
    BoardView,
    adjust_lens,
    choose_focal_length,
    held_out_rms,
    locate_board,
)
from calib.rig.camera import Camera, stated_sigma
from calib.rig.coverage import Coverage, cell_centres, choose_covering, enumerate_words, region_of
from calib.rig.estimation import CLEAR
from calib.rig.rig import Rig
from camera_node.foundation.arrays import Array, Grey
from camera_node.geometry.lens import Lens

BIG_RESIDUAL_PX = 1.0
CLEARLY_NOT_SQUARE = 0.005  # of fx / fy from 1: lenses of good cameras differ by less
Model = Literal["pinhole", "fisheye"]

COEFFICIENTS = {"pinhole": 5, "fisheye": 4}
NO_BOARD = "the board is in no image; check --board, and that the images show the whole board, sharp and not mirrored"
MIN_VIEWS = 8
MAX_VIEWS = 60  # more are slower, not better
MIN_TILT_DEG = 10.0  # between views: parallel views leave the focal length open
# Median projection uncertainty, as a fraction of the longer side: beyond, a lens is useless
MAX_SIGMA = 0.005
CLEARLY_BETTER = 0.8  # ratio of held-out residuals, below which the other lens model is suggested
MAX_EXAMINED = 6  # images without a board, in which a mirrored one is looked for
MAX_VIEW_RMS = 3.0  # of a view, in medians over views: beyond, it is an outlier (motion blur, a bent board)
TILT = "tilt the board by 30 degrees in all directions, and show it in every part of the image"


@dataclass(frozen=True, slots=True)
class CalibratedLens:
    """A calibrated lens.

    Attributes:
        camera: the lens, with standard deviations.
        adjusted: the adjustment of the views that were used.
        views: these views.
        frames: number of images in which the board was searched.
        rejected: RMS residual, pixels, of the rejected views, by name.
        coverage: corners of the used views, by cells of the image.
        sigma_px: (rows, columns) projection uncertainty, 1 sigma, at the centre of each cell.
        better_model: a sentence for the user where the other lens model fits better.
    """

    camera: Camera
    adjusted: AdjustedLens
    views: list[BoardView]
    frames: int
    rejected: dict[str, float]
    coverage: Coverage
    sigma_px: Array
    better_model: str = ""

    @property
    def rms_px(self) -> float:
        """RMS reprojection error."""
        return self.adjusted.rms_px

    def observed(self) -> Array:
        """(n, 2) corners of the used views, raw pixels."""
        return np.concatenate([view.pixels for view in self.views]).astype(float)

    def residuals(self) -> Array:
        """(n, 2) observed less predicted corners, pixels."""
        return np.concatenate(self.adjusted.residuals)

    def warnings(self) -> list[str]:
        """Weaknesses of the lens, each with what to do about it."""
        warnings = []
        if missing := self.coverage.missing():
            warnings.append(
                f"the projection uncertainty is {np.nanmedian(self.sigma_px):.1f} px (median of the image), but the "
                f"board was hardly in the {enumerate_words(missing)}, where distortion is extrapolated; show it "
                "there too"
            )
        if self.rms_px > BIG_RESIDUAL_PX:
            warnings.append(
                f"the residual is above {BIG_RESIDUAL_PX:g} px; check that the board is flat, the square's size is "
                "right and the images are sharp"
            )
        if corners := self._corners_without_ray():
            warnings.append(
                f"the lens has no inverse in the {enumerate_words(corners)} corner; show the board there"
            )
        ratio, sigma = aspect_ratio(self.adjusted)
        if abs(ratio - 1) > max(CLEARLY_NOT_SQUARE, CLEAR * sigma):
            warnings.append(
                f"its pixels are not square: fx / fy = {ratio:.4f} +- {sigma:.4f}; check that the driver does not "
                "scale the image"
            )
        if self.better_model:
            warnings.append(self.better_model)
        return warnings

    def _corners_without_ray(self) -> list[str]:
        """Names of the corners of the image that the lens model does not map to a ray."""
        width, height = self.camera.width, self.camera.height
        centres = cell_centres(width, height, (2, 2))
        corners = centres + np.sign(centres - centres.mean(axis=0)) * [width / 4, height / 4]
        known = np.isfinite(self.camera.normalise(corners)).all(axis=1)
        return [region_of(corner, width, height) for corner in corners[~known]]

    def as_dict(self) -> dict[str, Any]:
        """For the `calibration` map of `rig.yaml`."""
        return {
            "views": len(self.views),
            "frames": self.frames,
            "residual_px": round(self.rms_px, 4),
            "covered": round(self.coverage.share(), 3),
            "unknown_px": {
                "median": round(float(np.nanmedian(self.sigma_px)), 3),
                "worst": round(float(np.nanmax(self.sigma_px)), 3),
            },
            "rejected": {name: round(rms, 2) for name, rms in self.rejected.items()},
        }


def aspect_ratio(adjusted: AdjustedLens) -> tuple[float, float]:
    """fx / fy, and its standard deviation."""
    fx, fy = adjusted.lens.fx, adjusted.lens.fy
    J = np.array([1 / fy, -fx / fy**2])
    return fx / fy, float(np.sqrt(J @ adjusted.covariance[:2, :2] @ J))


def projection_sigma_px(adjusted: AdjustedLens, cells: tuple[int, ...]) -> Array:
    """Projection uncertainty (rows, columns), 1 sigma, at the centre of each cell, by the lens's covariance alone.

    The part that a rotation of the camera compensates is removed, because the pose absorbs it (mrcal's projection
    uncertainty). NaN where the lens sees nothing.
    """
    lens, cells = adjusted.lens, (cells[0], cells[1])
    rays = lens.rays(cell_centres(lens.width, lens.height, cells))
    known = np.isfinite(rays).all(axis=1)
    _, J_point, J_lens = lens.project_with_jacobians(rays[known])
    J_rotation = np.cross(rays[known][:, None, :], J_point).reshape(-1, 3)
    J = J_lens.reshape(len(J_rotation), -1)
    J = J - J_rotation @ np.linalg.lstsq(J_rotation, J)[0]
    cov = (J @ adjusted.covariance @ J.T).reshape(len(J) // 2, 2, len(J) // 2, 2)
    sigma = np.full(len(rays), np.nan)
    sigma[known] = np.sqrt(np.maximum(np.einsum("iaia->i", cov) / 2, 0))
    return sigma.reshape(cells)


class BoardViews:
    """Collects views of a board by one camera."""

    def __init__(self, camera: str, finder: BoardFinder) -> None:
        self.camera, self.finder = camera, finder
        self.views: list[BoardView] = []
        self.size: tuple[int, int] | None = None
        self.frames = 0
        self._without: list[Grey] = []

    def add(self, name: str, image: Grey, accept: Callable[[BoardView], bool] = lambda view: True) -> bool:
        """Find the board in an image (h, w); returns whether there was a view that `accept` accepts.

        Raises:
            CalibrationError: the image has another size than earlier ones.
        """
        size = (int(image.shape[1]), int(image.shape[0]))
        if self.size not in (None, size):
            raise CalibrationError(
                f"camera '{self.camera}' has images of different sizes ({name}: {size[0]} x {size[1]}, "
                f"before: {self.size[0]} x {self.size[1]}); use one size"
            )
        self.size, self.frames = size, self.frames + 1
        found = self.finder.find(image)
        if found is None and len(self._without) < MAX_EXAMINED:
            self._without.append(image)
        if found is None or not accept(view := BoardView(*found, name)):
            return False
        self.views.append(view)
        return True

    def coverage(self) -> Coverage:
        """The part of the image in which the board was seen."""
        width, height = self.size or (1, 1)
        return Coverage.of(np.concatenate([np.empty((0, 2)), *(v.area for v in self.views)]), width, height)

    def solve(self, model: Model = "pinhole") -> CalibratedLens:
        """Calibrate the lens from the views: select views, start, adjust, reject outliers, check.

        Raises:
            CalibrationError: too few views, or views that can't fix a lens; the message says what to show.
        """
        if self._is_mirrored():
            raise CalibrationError(
                f"camera '{self.camera}': its images show the board mirrored, as from behind; disable the flip of the "
                "camera, or of the driver"
            )
        if not self.views:
            raise CalibrationError(f"camera '{self.camera}': {NO_BOARD}")
        if self.size is None or len(self.views) < MIN_VIEWS:
            raise CalibrationError(
                f"camera '{self.camera}': the board is in {len(self.views)} of {self.frames} frames, {MIN_VIEWS} are "
                "needed; check --board, and show the board at several tilts, near and far, and in every corner of "
                "the image"
            )
        try:
            start, views = _start(choose_views(self.views, self.size), self.size, model)
            adjusted, views, rejected = _adjust_without_outliers(start, views)
            adjusted = _free_aspect(adjusted, views)
            coverage = Coverage.of(np.concatenate([view.area for view in views]), *self.size)
            sigma_px = projection_sigma_px(adjusted, coverage.counts.shape)
            _check_lens(adjusted, coverage, sigma_px)
        except CalibrationError as error:
            raise CalibrationError(f"camera '{self.camera}': {error}") from None
        lens_sigma = stated_sigma(adjusted.lens, np.sqrt(np.diag(adjusted.covariance)).tolist())
        camera = Camera(**msgspec.structs.asdict(adjusted.lens), lens_sigma=lens_sigma)
        return CalibratedLens(camera, adjusted, views, self.frames, rejected, coverage, sigma_px)

    def calibrate(self, model: Model = "pinhole") -> CalibratedLens:
        """As `solve`; the result, or the error, also says where the other model of a lens fits better."""
        suggested = self.compare_models(model)
        try:
            return replace(self.solve(model), better_model=suggested)
        except CalibrationError as error:
            raise CalibrationError(f"{error}; {suggested}" if suggested else str(error)) from None

    def _is_mirrored(self) -> bool:
        """Whether most views show the board from behind, or it is found in most images without it once mirrored.

        A chessboard looks the same in a mirror: only boards with numbered corners show it.
        """
        behind = sum(is_from_behind(view) for view in self.views)
        if 2 * behind > len(self.views):
            return True
        if len(self.views) >= MIN_VIEWS:
            return False
        found = sum(
            self.finder.find(np.ascontiguousarray(image[:, ::-1])) is not None for image in self._without
        )
        return isinstance(self.finder, CharucoFinder) and 2 * found > max(len(self._without), 1)

    def compare_models(self, model: Model) -> str:
        """A sentence for the user where the other model of a lens fits held-out views better; else empty.

        Both models are adjusted to every other view; the rest is held out.
        """
        if self.size is None or len(self.views) < 2 * MIN_VIEWS:
            return ""
        views = choose_views(self.views, self.size)
        other: Model = "fisheye" if model == "pinhole" else "pinhole"
        rms = {kind: _held_out(views, self.size, kind) for kind in (model, other)}
        if not rms[other] < CLEARLY_BETTER * rms[model]:
            return ""
        return (
            f"held-out views fit the {other} model better: residual {rms[other]:.2f} px, with the {model} model "
            f"{rms[model]:.2f} px; run again with --model {other}"
        )


def _held_out(views: Sequence[BoardView], size: tuple[int, int], model: Model) -> float:
    """RMS residual of every other view, of a lens adjusted to the rest; infinite where none can be."""
    try:
        start, fitted = _start(views[::2], size, model)
        return held_out_rms(adjust_lens(start, fitted, robust=True).lens, views[1::2])
    except (CalibrationError, ValueError, np.linalg.LinAlgError):
        return float("inf")


def is_from_behind(view: BoardView) -> bool:
    """Whether the corners are in the order of a board that is seen from behind: the board's x and y axes are that of
    the image, turned by any angle but not mirrored, where it is seen from the front."""
    board = np.column_stack([view.corners[:, :2], np.ones(len(view.corners))])
    M = np.linalg.lstsq(board, view.pixels)[0]
    return float(np.linalg.det(M[:2])) < 0


def choose_views(views: Sequence[BoardView], size: tuple[int, int]) -> list[BoardView]:
    """Select up to `MAX_VIEWS` views that fill the image evenly."""
    if len(views) <= MAX_VIEWS:
        return list(views)
    counts = np.array([Coverage.of(view.area, *size).counts.ravel() for view in views], float)
    return [view for view, chosen in zip(views, choose_covering(counts, MAX_VIEWS), strict=True) if chosen]


def _start(views: Sequence[BoardView], size: tuple[int, int], model: Model) -> tuple[Lens, list[BoardView]]:
    """A lens without distortion, and the views in which it locates the board."""
    centre = {"width": size[0], "height": size[1], "cx": (size[0] - 1) / 2, "cy": (size[1] - 1) / 2}
    lens = Lens(**centre, fx=1.0, fy=1.0, distortion=(0.0,) * COEFFICIENTS[model], model=model)
    lens = choose_focal_length(lens, views)
    located = [view for view in views if locate_board(lens, view) is not None]
    if len(located) < MIN_VIEWS:
        raise CalibrationError(f"its views do not fit a lens of model {model}; {TILT}")
    return lens, located


def _adjust_without_outliers(
    start: Lens, views: list[BoardView]
) -> tuple[AdjustedLens, list[BoardView], dict[str, float]]:
    """Adjust robustly, then without outliers until none is left: the lens, its views, and the rejected ones' RMS."""
    adjusted = adjust_lens(start, views, robust=True)
    rejected: dict[str, float] = {}
    while True:
        rms = adjusted.view_rms_px
        good = rms <= max(MAX_VIEW_RMS * float(np.median(rms)), 0.1)
        rejected |= {v.name: float(e) for v, e, ok in zip(views, rms, good, strict=True) if not ok}
        views = [view for view, ok in zip(views, good, strict=True) if ok]
        if len(views) < MIN_VIEWS:
            worst = ", ".join(sorted(rejected, key=lambda name: -rejected[name])[:3])
            raise CalibrationError(
                f"only {len(views)} views agree with each other, {MIN_VIEWS} are needed (the worst: {worst}); check "
                "that the board is flat and the images are sharp"
            )
        adjusted = adjust_lens(adjusted.lens, views)
        if good.all():
            return adjusted, views, rejected


def _free_aspect(adjusted: AdjustedLens, views: Sequence[BoardView]) -> AdjustedLens:
    """The lens adjusted without the prior of square pixels, where the views show that they are not square."""
    free = adjust_lens(adjusted.lens, views, aspect_sigma=ANY_SIGMA)
    ratio, sigma = aspect_ratio(free)
    return free if abs(ratio - 1) > CLEAR * sigma else adjusted


def _check_lens(adjusted: AdjustedLens, coverage: Coverage, sigma_px: Array) -> None:
    """Raise CalibrationError if the views can't fix a lens."""
    tilt = largest_tilt_deg(adjusted.poses)
    if tilt < MIN_TILT_DEG:
        raise CalibrationError(
            f"the views differ by {tilt:.0f} degrees, and parallel views can't fix a lens; {TILT}"
        )
    typical = float(np.nanmedian(sigma_px))
    if typical > MAX_SIGMA * max(adjusted.lens.width, adjusted.lens.height):
        missing = coverage.missing()
        few = 0 < len(missing) <= 5
        where = f"in the {enumerate_words(missing)} of the image too" if few else "in every part of the image"
        raise CalibrationError(
            f"the projection uncertainty is {typical:.0f} px, with the board in {coverage.share():.0%} of the image; "
            f"show it nearer, tilted by 30 degrees in all directions, and {where}"
        )


def largest_tilt_deg(poses: Array) -> float:
    """The largest angle between the board's normals in any two views (V, 4, 4)."""
    normals = poses[:, :3, 2]
    return float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1))))


def merge_lenses(rig: Rig | None, lenses: dict[str, CalibratedLens], provenance: dict[str, Any]) -> Rig:
    """Put new lenses into a rig. A camera with a new lens loses its pose, which was found with the old lens.

    `provenance` (date, command, board) is stored with each lens in the rig's `calibration`.
    """
    rig = rig or Rig(cameras={})
    cameras = rig.cameras | {name: lens.camera for name, lens in lenses.items()}
    entries = {name: {**provenance, **lens.as_dict()} for name, lens in lenses.items()}
    calibration = {**rig.calibration, "lenses": {**rig.calibration.get("lenses", {}), **entries}}
    return msgspec.structs.replace(rig, cameras=cameras, calibration=calibration)
