# SPDX-License-Identifier: BSD-3-Clause
"""A board shown to a running camera: which pictures are worth keeping, what is still missing, and when it is enough."""

from collections.abc import Callable, Iterable
from functools import partial

import numpy as np
from rich.console import Group
from rich.text import Text

from calib.errors import CalibrationError
from calib.intrinsics.adjustment import BoardView
from calib.intrinsics.calibrate import MIN_VIEWS, BoardViews, CalibratedLens, Model
from calib.rig.coverage import Coverage, enumerate_words
from camera_node.arrays import Grey

NEW = 0.04  # of the image's width, that a view must differ from every one before
EVERY = 5  # views, between two trial calibrations
ENOUGH_VIEWS = 20
ENOUGH_COVERED = 0.8  # of the image's cells
ENOUGH_KNOWN_PX = (
    0.3  # in the median of the image: below, another view changes less than corners are found to
)


def show_board(
    views: BoardViews,
    pictures: Iterable[tuple[str, Grey]],
    model: Model,
    tell: Callable[[Group], None] = lambda panel: None,
) -> str:
    """Fill `views` from a running camera's pictures until they are enough, or the pictures end.

    Enough are 20 views that cover 80 % of the image and fix the lens to 0.3 px in its median.

    Returns:
        why it ended.
    """
    said = f"{MIN_VIEWS} views are needed"
    told = False
    for name, image in pictures:
        added = views.add(name, image, partial(is_new, others=views.views, width=image.shape[1]))
        if added and len(views.views) >= MIN_VIEWS and len(views.views) % EVERY == 0:
            lens, said = _try(views, model)
            told = lens is not None and _enough(lens)
        tell(panel(views, said, added))
        if told:
            return "that is enough: " + said
    return "the time is over: " + said


def is_new(view: BoardView, others: list[BoardView], width: int) -> bool:
    """Whether a view's place, size or tilt differs from those of all others."""
    mine = _shape(view)
    return all(np.abs(mine - _shape(other)).max() > NEW * width for other in others)


def _shape(view: BoardView) -> np.ndarray:
    """Where the view's board would reach: the affine image of the board's own axes, pixels."""
    board = np.column_stack([view.corners[:, :2], np.ones(len(view.corners))])
    extent = np.ptp(view.corners[:, :2], axis=0).max()
    M = np.linalg.lstsq(board, view.pixels)[0]
    return np.concatenate([M[:2].ravel() * extent, view.pixels.mean(axis=0)])


def _try(views: BoardViews, model: Model) -> tuple[CalibratedLens | None, str]:
    try:
        lens = views.solve(model)
    except CalibrationError as error:
        return None, str(error).split(": ", 1)[-1]
    typical = float(np.nanmedian(lens.unknown_px))
    return lens, f"residual {lens.rms_px:.2f} px, lens known to {typical:.2f} px"


def _enough(lens: CalibratedLens) -> bool:
    known = float(np.nanmedian(lens.unknown_px)) <= ENOUGH_KNOWN_PX
    return known and len(lens.views) >= ENOUGH_VIEWS and lens.coverage.share() >= ENOUGH_COVERED


def panel(views: BoardViews, said: str, added: bool) -> Group:
    """What a person sees: the image's cells as they fill, and what to do next."""
    coverage = views.coverage()
    head = (
        f"{views.camera}: {len(views.views)} views of {views.frames} pictures, {coverage.share():.0%} covered"
    )
    missing = coverage.missing()
    todo = f"show the board in the {enumerate_words(missing[:3])}" if missing else "tilt it to all sides"
    return Group(
        Text(head, "bold green" if added else "bold"), cells(coverage), Text(said), Text(todo, "yellow")
    )


def cells(coverage: Coverage) -> Text:
    """The image's cells as blocks: the fuller, the darker."""
    text = Text()
    for row in coverage.counts:
        for count in row:
            text.append(
                " ░▒▓█"[min(int(np.ceil(np.log2(count / 8 + 1))), 4) if count else 0] * 2 or "  ", "cyan"
            )
        text.append("\n")
    return text
