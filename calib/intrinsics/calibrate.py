# SPDX-License-Identifier: BSD-3-Clause
"""Calibrates a lens from views of a board (Zhang 2000): selects views, rejects outliers, and checks the result."""

from collections.abc import Callable, Sequence
from typing import Any, Literal

import msgspec
import numpy as np

from calib.errors import CalibrationError
from calib.intrinsics.adjustment import (
    AdjustedLens,
    BoardView,
    adjust_lens,
    choose_focal_length,
    locate_board,
)
from calib.intrinsics.board import BoardFinder
from calib.intrinsics.calibrated_lens import CalibratedLens, projection_sigma_px
from calib.rig.camera import Camera
from calib.rig.coverage import Coverage, enumerate_words
from calib.rig.rig import Rig
from camera_node.arrays import Array, Grey
from camera_node.geometry.lens import Lens

Model = Literal["pinhole", "fisheye"]

COEFFICIENTS = {"pinhole": 5, "fisheye": 4}
MIN_VIEWS = 8
MAX_VIEWS = 60  # more are slower, not better
MIN_TILT_DEG = 10.0  # between views: parallel views leave the focal length open
MAX_SIGMA = (
    0.005  # median projection uncertainty, as a fraction of the longer side: beyond, a lens is useless
)
MAX_VIEW_RMS = 3.0  # of a view, in medians over views: beyond, it is an outlier (motion blur, a bent board)
TILT = "tilt the board by 30 degrees in all directions, and show it in every part of the image"


class BoardViews:
    """Collects views of a board by one camera."""

    def __init__(self, camera: str, finder: BoardFinder) -> None:
        self.camera, self.finder = camera, finder
        self.views: list[BoardView] = []
        self.size: tuple[int, int] | None = None
        self.frames = 0

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
        if (found := self.finder.find(image)) is None or not accept(view := BoardView(*found, name)):
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
        if self.size is None or len(self.views) < MIN_VIEWS:
            raise CalibrationError(
                f"camera '{self.camera}': the board is in {len(self.views)} of {self.frames} frames, {MIN_VIEWS} are "
                "needed; check --board, and show the board at several tilts, near and far, and in every corner of "
                "the image"
            )
        try:
            start, views = _start(choose_views(self.views, self.size), self.size, model)
            adjusted, views, rejected = _adjust_without_outliers(start, views)
            coverage = Coverage.of(np.concatenate([view.area for view in views]), *self.size)
            sigma_px = projection_sigma_px(adjusted, coverage.counts.shape)
            _check_lens(adjusted, coverage, sigma_px)
        except CalibrationError as error:
            raise CalibrationError(f"camera '{self.camera}': {error}") from None
        lens_sigma = tuple(float(x) for x in np.sqrt(np.diag(adjusted.covariance)))
        camera = Camera(**msgspec.structs.asdict(adjusted.lens), lens_sigma=lens_sigma)
        return CalibratedLens(camera, adjusted, views, self.frames, rejected, coverage, sigma_px)


def choose_views(views: Sequence[BoardView], size: tuple[int, int], most: int = MAX_VIEWS) -> list[BoardView]:
    """Select up to `most` views that fill the image evenly: each next one adds most to the cells with few corners."""
    if len(views) <= most:
        return list(views)
    counts = [Coverage.of(view.area, *size).counts.astype(float) for view in views]
    filled, chosen = np.zeros_like(counts[0]), []
    remaining = list(range(len(views)))
    while len(chosen) < most:
        best = max(remaining, key=lambda k: float((counts[k] / (1 + filled)).sum()))
        filled += counts[best]
        chosen.append(best)
        remaining.remove(best)
    return [views[k] for k in sorted(chosen)]


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
