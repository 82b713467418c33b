# SPDX-License-Identifier: BSD-3-Clause
"""From views of a board to a lens (Zhang 2000): which views to take, which to leave out, and when to refuse."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import msgspec
import numpy as np

from calib.errors import CalibrationError
from calib.intrinsics.adjustment import AdjustedLens, BoardView, adjust_lens, locate, start_lens
from calib.intrinsics.board import Finder
from calib.rig.camera import Camera
from calib.rig.coverage import Coverage, cell_centres, enumerate_words, region_of
from calib.rig.rig import Rig
from camera_node.arrays import Array, Grey
from camera_node.geometry.lens import Lens

Model = Literal["pinhole", "fisheye"]

COEFFICIENTS = {"pinhole": 5, "fisheye": 4}
MIN_VIEWS = 8
MAX_VIEWS = 60  # more make it slow, not better
MIN_TILT_DEG = 10.0  # that views must differ by: parallel views leave the focal length open
MAX_UNKNOWN = (
    0.005  # of the longer side: a lens known worse than this, in the median of the image, is of no use
)
REJECT = 3.0  # times the median residual of a view: motion blur, a bent board, a wrong corner


@dataclass(frozen=True, slots=True)
class CalibratedLens:
    """A calibrated lens and what its views say of it.

    Attributes:
        camera: the lens, with standard deviations.
        adjusted: the adjustment, of the views that were used.
        views: these views.
        frames: pictures that were looked at.
        rejected: RMS residual, pixels, of views that were left out, by name.
        coverage: corners of the used views in cells of the image.
        unknown_px: (rows, columns) how far, 1 sigma, a pixel in the middle of each cell may be off.
    """

    camera: Camera
    adjusted: AdjustedLens
    views: list[BoardView]
    frames: int
    rejected: dict[str, float]
    coverage: Coverage
    unknown_px: Array

    @property
    def rms_px(self) -> float:
        """RMS reprojection error."""
        return self.adjusted.rms_px

    def seen(self) -> Array:
        """(n, 2) the corners of the used views, raw pixels."""
        return np.concatenate([view.pixels for view in self.views]).astype(float)

    def residuals(self) -> Array:
        """(n, 2) these less where the lens expects them."""
        return np.concatenate(self.adjusted.residuals)

    def warnings(self) -> list[str]:
        """What a person should do better next time."""
        told = []
        if missing := self.coverage.missing():
            told.append(
                f"the lens is known to {np.nanmedian(self.unknown_px):.1f} px (median of the image), but the board was "
                f"hardly in the {enumerate_words(missing)}: distortion is a guess there; show it there too"
            )
        if self.rms_px > 1.0:
            told.append(
                "a residual above 1 px: is the board flat, the square's size right, the picture sharp?"
            )
        corners = cell_centres(self.camera.width, self.camera.height, (2, 2))
        ends = corners + np.sign(corners - corners.mean(axis=0)) * [
            self.camera.width / 4,
            self.camera.height / 4,
        ]
        if folded := [
            region_of(end, self.camera.width, self.camera.height)
            for end, xy in zip(ends, self.camera.normalise(ends), strict=True)
            if not np.isfinite(xy).all()
        ]:
            told.append(
                f"the lens has no inverse in the {enumerate_words(folded)} corner; show the board there"
            )
        return told

    def as_dict(self) -> dict[str, Any]:
        """For the `calibration` map of `rig.yaml`."""
        return {
            "views": len(self.views),
            "frames": self.frames,
            "residual_px": round(self.rms_px, 4),
            "covered": round(self.coverage.share(), 3),
            "unknown_px": {
                "median": round(float(np.nanmedian(self.unknown_px)), 3),
                "worst": round(float(np.nanmax(self.unknown_px)), 3),
            },
            "rejected": {name: round(rms, 2) for name, rms in self.rejected.items()},
        }


def calibrate_lens(
    name: str, pictures: Iterable[tuple[str, Grey]], finder: Finder, model: Model = "pinhole"
) -> CalibratedLens:
    """The lens of camera `name` from named pictures of a board.

    Raises:
        CalibrationError: too few views, views that can't fix a lens, or pictures of different sizes.
    """
    views = BoardViews(name, finder)
    for picture, image in pictures:
        views.add(picture, image)
    return views.solve(model)


class BoardViews:
    """Views of a board by one camera, as they come in."""

    def __init__(self, camera: str, finder: Finder) -> None:
        self.camera, self.finder = camera, finder
        self.views: list[BoardView] = []
        self.size: tuple[int, int] | None = None
        self.frames = 0

    def add(self, name: str, image: Grey, wanted: Callable[[BoardView], bool] = lambda view: True) -> bool:
        """Look for the board in a grey image (h, w); whether there was a view that is wanted.

        Raises:
            CalibrationError: the image has another size than those before.
        """
        size = (int(image.shape[1]), int(image.shape[0]))
        if self.size not in (None, size):
            raise CalibrationError(
                f"camera '{self.camera}' has pictures of different sizes ({name}: {size[0]} x {size[1]}, "
                f"before: {self.size[0]} x {self.size[1]}); keep one size"
            )
        self.size, self.frames = size, self.frames + 1
        if (found := self.finder.find(image)) is None or not wanted(view := BoardView(*found, name)):
            return False
        self.views.append(view)
        return True

    def coverage(self) -> Coverage:
        """Where in the image corners were seen."""
        width, height = self.size or (1, 1)
        return Coverage.of(np.concatenate([np.empty((0, 2)), *(v.area for v in self.views)]), width, height)

    def solve(self, model: Model = "pinhole") -> CalibratedLens:
        """The lens that the views give.

        Raises:
            CalibrationError: too few views, or views that can't fix a lens; the message says what to show.
        """
        if self.size is None or len(self.views) < MIN_VIEWS:
            raise CalibrationError(
                f"camera '{self.camera}': the board is in {len(self.views)} of {self.frames} frames, {MIN_VIEWS} are "
                "needed; does --board match the print? Show it at several tilts, near and far, and in every "
                "corner of the image"
            )
        return _solve(self.camera, self.views, self.size, self.frames, model)


def _solve(
    name: str, views: list[BoardView], size: tuple[int, int], frames: int, model: Model
) -> CalibratedLens:
    chosen = choose_views(views, size)
    first = _start(name, chosen, size, model)
    rejected: dict[str, float] = {}
    chosen = [view for view in chosen if locate(first, view) is not None]
    adjusted = adjust_lens(first, chosen, robust=True)
    while True:
        rms = adjusted.view_rms_px
        good = rms <= max(REJECT * float(np.median(rms)), 0.1)
        rejected |= {v.name: float(e) for v, e, ok in zip(chosen, rms, good, strict=True) if not ok}
        chosen = [view for view, ok in zip(chosen, good, strict=True) if ok]
        if len(chosen) < MIN_VIEWS:
            raise CalibrationError(f"camera '{name}': {_contradiction(rejected, len(chosen))}")
        adjusted = adjust_lens(adjusted.lens, chosen)
        if good.all():
            break
    coverage = Coverage.of(np.concatenate([view.area for view in chosen]), *size)
    unknown = unknown_px(adjusted, coverage.counts.shape)
    if fault := _fault(adjusted, coverage, unknown):
        raise CalibrationError(f"camera '{name}': {fault}")
    sigma = tuple(float(x) for x in np.sqrt(np.diag(adjusted.covariance)))
    camera = Camera(**msgspec.structs.asdict(adjusted.lens), lens_sigma=sigma)
    return CalibratedLens(camera, adjusted, chosen, frames, rejected, coverage, unknown)


def _start(name: str, views: Sequence[BoardView], size: tuple[int, int], model: Model) -> Lens:
    middle = {"width": size[0], "height": size[1], "cx": (size[0] - 1) / 2, "cy": (size[1] - 1) / 2}
    lens = start_lens(
        Lens(**middle, fx=1.0, fy=1.0, distortion=(0.0,) * COEFFICIENTS[model], model=model), views
    )
    if sum(locate(lens, view) is not None for view in views) < MIN_VIEWS:
        raise CalibrationError(f"camera '{name}': its views fit no lens of model {model}; {_TILT}")
    return lens


_TILT = "tilt the board by 30 degrees to all sides, and show it in every part of the image"


def _contradiction(rejected: dict[str, float], left: int) -> str:
    worst = sorted(rejected, key=lambda name: -rejected[name])[:3]
    return (
        f"only {left} views agree with each other, {MIN_VIEWS} are needed (the worst: {', '.join(worst)}); "
        "is the board flat and the picture sharp?"
    )


def _fault(adjusted: AdjustedLens, coverage: Coverage, unknown: Array) -> str:
    """Why the views can't fix a lens, and what to do; empty where they can."""
    tilt = largest_tilt_deg(adjusted.poses)
    if tilt < MIN_TILT_DEG:
        return f"the views differ by {tilt:.0f} degrees, and parallel views can't fix a lens; {_TILT}"
    typical = float(np.nanmedian(unknown))
    if typical > MAX_UNKNOWN * max(adjusted.lens.width, adjusted.lens.height):
        return (
            f"the views fix the lens to {typical:.0f} px only, with the board in {coverage.share():.0%} of the image; "
            f"show it nearer, tilted by 30 degrees to all sides, and {_where(coverage)}"
        )
    return ""


def _where(coverage: Coverage) -> str:
    missing = coverage.missing()
    if not 0 < len(missing) <= 5:
        return "in every part of the image"
    return f"in the {enumerate_words(missing)} of the image too"


def choose_views(views: Sequence[BoardView], size: tuple[int, int], most: int = MAX_VIEWS) -> list[BoardView]:
    """Up to `most` views that fill the image evenly: each next one brings most corners to cells with few of them."""
    if len(views) <= most:
        return list(views)
    counts = [Coverage.of(view.area, *size).counts.astype(float) for view in views]
    filled, chosen = np.zeros_like(counts[0]), []
    left = list(range(len(views)))
    while len(chosen) < most:
        best = max(left, key=lambda k: float((counts[k] / (1 + filled)).sum()))
        filled += counts[best]
        chosen.append(best)
        left.remove(best)
    return [views[k] for k in sorted(chosen)]


def largest_tilt_deg(poses: Array) -> float:
    """The largest angle between the board's normals in any two views (V, 4, 4)."""
    normals = poses[:, :3, 2]
    return float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1))))


def unknown_px(adjusted: AdjustedLens, cells: tuple[int, ...]) -> Array:
    """How far, 1 sigma, a pixel in the middle of each cell may be off, by the lens's covariance alone.

    What a turn of the camera would undo is taken out, as it is the pose's to settle (mrcal's projection uncertainty).
    NaN where the lens sees nothing.
    """
    lens, cells = adjusted.lens, (cells[0], cells[1])
    rays = lens.rays(cell_centres(lens.width, lens.height, cells))
    known = np.isfinite(rays).all(axis=1)
    _, J_point, J_lens = lens.project_with_jacobians(rays[known])
    J_turn = np.cross(rays[known][:, None, :], J_point).reshape(-1, 3)
    J = J_lens.reshape(len(J_turn), -1)
    J = J - J_turn @ np.linalg.lstsq(J_turn, J)[0]
    cov = (J @ adjusted.covariance @ J.T).reshape(len(J) // 2, 2, len(J) // 2, 2)
    out = np.full(len(rays), np.nan)
    out[known] = np.sqrt(np.maximum(np.einsum("iaia->i", cov) / 2, 0))
    return out.reshape(cells)


def merge(rig: Rig | None, lenses: dict[str, CalibratedLens], told: dict[str, Any] | None = None) -> Rig:
    """The rig with new lenses; a camera's pose belongs to the lens that it was found with and goes.

    `told` (date and command) stands with each lens in the rig's `calibration`.
    """
    rig = rig or Rig(cameras={})
    cameras = rig.cameras | {name: lens.camera for name, lens in lenses.items()}
    entries = {name: {**(told or {}), **lens.as_dict()} for name, lens in lenses.items()}
    calibration = {**rig.calibration, "lenses": {**rig.calibration.get("lenses", {}), **entries}}
    return msgspec.structs.replace(rig, cameras=cameras, calibration=calibration)
