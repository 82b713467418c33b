# SPDX-License-Identifier: BSD-3-Clause
"""Captures views of a board from a running camera: selects distinct views, gives advice, and ends when they suffice."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np
from rich.console import Group
from rich.text import Text

from calib.errors import CalibrationError
from calib.intrinsics.images import NamedImage
from calib.intrinsics.lens_adjustment import BoardView
from calib.intrinsics.lens_calibration import MIN_VIEWS, BoardViews, CalibratedLens, Model
from calib.rig.coverage import Coverage, enumerate_words
from camera_node.foundation.arrays import Array

MIN_CHANGE = 0.04  # of the image's width, by which a view must differ from each earlier one
TRIAL_EVERY = 5  # views
ENOUGH_VIEWS = 20
ENOUGH_COVERED = 0.8  # of the image's cells
ENOUGH_SIGMA_PX = 0.3  # median over the image: below, another view changes less than the noise of corners
SHADES, CORNERS_PER_SHADE = " ░▒▓█", 8  # of a cell, by the logarithm of its number of corners


@dataclass(frozen=True, slots=True)
class CaptureProgress:
    """The state of a capture.

    Attributes:
        camera: its name.
        n_views, n_images: distinct views, and images in which the board was searched.
        coverage: of the image by corners of the board.
        figures: of the latest trial lens, or what is needed for one.
        added: whether the latest image was a distinct view.
    """

    camera: str
    n_views: int
    n_images: int
    coverage: Coverage
    figures: str
    added: bool

    @property
    def summary(self) -> str:
        """The number of views, and the covered share of the image."""
        return f"{self.camera}: {self.n_views} views of {self.n_images} images, {self.coverage.share():.0%} covered"

    @property
    def advice(self) -> str:
        """What to show next."""
        if missing := self.coverage.missing():
            return f"show the board in the {enumerate_words(missing[:3])}"
        return "tilt the board in all directions"


def capture_views(
    views: BoardViews,
    images: Iterable[NamedImage],
    model: Model,
    show: Callable[[CaptureProgress], None] = lambda progress: None,
) -> str:
    """Add distinct views from a running camera's images to `views`, until they suffice or the images end.

    20 views suffice if they cover 80 % of the image and fix the lens to 0.3 px in the median of the image.

    Returns:
        the reason for the end, and the figures of the lens.
    """
    figures = f"{MIN_VIEWS} views are needed"
    sufficient = False
    for name, image in images:
        added = views.add(name, image, partial(is_distinct, others=views.views, width=image.shape[1]))
        if added and len(views.views) >= MIN_VIEWS and len(views.views) % TRIAL_EVERY == 0:
            lens, figures = _try_solve(views, model)
            sufficient = lens is not None and is_sufficient(lens)
        show(CaptureProgress(views.camera, len(views.views), views.frames, views.coverage(), figures, added))
        if sufficient:
            return f"there are enough views: {figures}"
    return f"the capture ended: {figures}"


def is_distinct(view: BoardView, others: list[BoardView], width: int) -> bool:
    """Whether the position, size or tilt of a view differs from those of all others."""
    corners = _board_outline(view)
    return all(np.abs(corners - _board_outline(other)).max() > MIN_CHANGE * width for other in others)


def _board_outline(view: BoardView) -> Array:
    """(6,) the affine image of the board: its axes, scaled to the extent of the visible corners, and its centre."""
    board = np.column_stack([view.corners[:, :2], np.ones(len(view.corners))])
    extent = np.ptp(view.corners[:, :2], axis=0).max()
    M = np.linalg.lstsq(board, view.pixels)[0]
    return np.concatenate([M[:2].ravel() * extent, view.pixels.mean(axis=0)])


def _try_solve(views: BoardViews, model: Model) -> tuple[CalibratedLens | None, str]:
    try:
        lens = views.solve(model)
    except CalibrationError as error:
        return None, str(error).split(": ", 1)[-1]
    sigma_px = float(np.nanmedian(lens.sigma_px))
    return lens, f"residual {lens.rms_px:.2f} px, projection uncertainty {sigma_px:.2f} px"


def is_sufficient(lens: CalibratedLens) -> bool:
    """Whether more views would not improve a lens."""
    precise = float(np.nanmedian(lens.sigma_px)) <= ENOUGH_SIGMA_PX
    return precise and len(lens.views) >= ENOUGH_VIEWS and lens.coverage.share() >= ENOUGH_COVERED


def make_panel(progress: CaptureProgress) -> Group:
    """The state of a capture for the terminal: the covered cells of the image, and what to do next."""
    return Group(
        Text(progress.summary, "bold green" if progress.added else "bold"),
        _draw_cells(progress.coverage),
        Text(progress.figures),
        Text(progress.advice, "yellow"),
    )


def _draw_cells(coverage: Coverage) -> Text:
    """The cells of the image as blocks, darker with more corners."""
    text = Text()
    for row in coverage.counts:
        for count in row:
            shade = int(np.ceil(np.log2(count / CORNERS_PER_SHADE + 1)))
            text.append(SHADES[min(shade, len(SHADES) - 1)] * 2, "cyan")
        text.append("\n")
    return text
