# SPDX-License-Identifier: BSD-3-Clause
"""The result of a lens calibration, with its projection uncertainty and warnings."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.intrinsics.adjustment import AdjustedLens, BoardView
from calib.rig.camera import Camera
from calib.rig.coverage import Coverage, cell_centres, enumerate_words, region_of
from camera_node.foundation.arrays import Array

BIG_RESIDUAL_PX = 1.0
CLEARLY_NOT_SQUARE = 0.005  # of fx / fy from 1: lenses of good cameras differ by less


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
        if abs(ratio - 1) > max(CLEARLY_NOT_SQUARE, 3 * sigma):
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
