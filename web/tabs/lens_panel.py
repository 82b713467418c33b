# SPDX-License-Identifier: BSD-3-Clause
"""The lens of one camera: its state, and its calibration with a board; `roundel calibrate intrinsics --live` does so
in a terminal."""

import math
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from itertools import takewhile
from typing import Any

import cv2
import numpy as np
import viser

from calib.intrinsics.board import make_finder
from calib.intrinsics.guided_capture import CaptureProgress, capture_views
from calib.intrinsics.images import take_snapshots
from calib.intrinsics.lens_calibration import BoardViews, CalibratedLens, Model, merge_lenses
from calib.intrinsics.residual_plot import draw_residuals
from calib.rig.rig import Rig
from web.errors import WebError
from web.html_tables import draw_cells, small
from web.own_control import OwnControl, each_browser
from web.state.feed import ArenaState
from web.state.subscription import Subscription
from web.tabs.calibration_panels import CalibrationFiles, apply_rig, current_rig
from web.widgets import Answer, Decision, LongAction, inside, set_content

BOARD = "charuco:5x7:0.035"  # of `roundel print board`
MODELS = ("pinhole", "fisheye")
WIDE = "fisheye for lenses beyond 120 degrees"
CAPTURE_S = 180.0
LABELS = ("Calibrate the lens with a board", "End, and calibrate")
BOARD_HINT = (
    "charuco:COLUMNSxROWS:SQUARE_M as roundel print board writes it, or chessboard:COLUMNSxROWS:SQUARE_M"
)


class LensPanel:
    """The folder "Lens" of the selected camera.

    Args:
        server: of the page.
        subscription: connected to the arena.
        files: the rig in which the lens is saved.
        camera: returns the name of the selected camera.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        subscription: Subscription,
        files: CalibrationFiles,
        camera: Callable[[], str],
    ) -> None:
        self._server, self._subscription, self._files, self._camera = server, subscription, files, camera
        gui = server.gui
        self._folder = place = gui.add_folder("Lens")
        with place:
            self._state = OwnControl(server, place, lambda gui: gui.add_html(""))
            self._board = OwnControl(server, place, lambda gui: gui.add_text("Board", BOARD, hint=BOARD_HINT))
            self._model = OwnControl(server, place, lambda gui: gui.add_dropdown("Model", MODELS, hint=WIDE))
            self._answer = answer = Answer(gui)
            self._capture = LongAction(gui, LABELS, self._calibrate, answer)
            self._cells = gui.add_html("")
            self.decision = Decision(gui, "the lens", self._use, self._forget, answer)
        self._residuals: viser.GuiImageHandle | None = None

    def update(self, state: ArenaState) -> None:
        """Show the lens of the selected camera, and enable the buttons that can act."""
        for _ in each_browser(self._server):
            with suppress(WebError):  # the camera was renamed or forgotten
                set_content(self._state.here, small(describe_lens(state.rig, self._camera())))
        self._capture.show(enabled=bool(state.cameras))
        self.decision.show(enabled=not self._capture.is_running)

    def _use(self, candidate: tuple[str, CalibratedLens, str]) -> str:
        """Write the lens into the rig, and have the server use it; the camera's pose becomes void.

        Raises:
            CalibrationError, ConfigError: the rig can't be read or written.
        """
        name, lens, board = candidate
        provenance = {
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "command": "the page",
            "board": board,
        }
        rig = merge_lenses(current_rig(self._subscription, self._files), {name: lens}, provenance)
        outcome = apply_rig(self._subscription, self._files, rig)
        return f"the lens of {name}: {outcome}; its pose is void: record a wand session in Calibrate"

    def close(self) -> None:
        """End a capture."""
        self._capture.close()

    def _forget(self) -> str:
        set_content(self._cells, "")
        if self._residuals is not None:
            self._residuals.remove()
            self._residuals = None
        return ""

    def _calibrate(self, end: threading.Event) -> str:
        """Capture views until they suffice or the user ends it; returns the figures of the lens."""
        self.decision.clear()
        name, board = self._camera(), str(self._board.here.value)
        model: Model = "fisheye" if self._model.here.value == "fisheye" else "pinhole"
        views = BoardViews(name, make_finder(board))
        session, arena = self._subscription.session, self._subscription.feed.keys.arena
        images = takewhile(lambda _: not end.is_set(), take_snapshots(session, arena, name, CAPTURE_S))
        reason = capture_views(views, images, model, self._show)
        if self._capture.is_closed:
            return ""
        self._capture.handle.disabled = True
        self._answer.show(f"{reason}; calibrating")
        lens = replace(views.solve(model), better_model=views.compare_models(model))
        self.decision.result = name, lens, board
        self._show_residuals(name, lens)
        return summarize_lens(name, lens)

    def _show(self, progress: CaptureProgress) -> None:
        set_content(self._cells, draw_cells(progress.coverage, "where the board was seen"))
        self._answer.show(f"{progress.summary}; {progress.figures}; {progress.advice}")

    def _show_residuals(self, name: str, lens: CalibratedLens) -> None:
        drawn = draw_residuals(name, lens.camera, lens.observed(), lens.residuals())
        with inside(self._folder):
            picture = np.ascontiguousarray(cv2.cvtColor(drawn, cv2.COLOR_BGR2RGB), np.uint8)
            self._residuals = self._server.gui.add_image(picture, label="residuals", format="jpeg")


def summarize_lens(name: str, lens: CalibratedLens) -> str:
    """The figures of a calibrated lens, its warnings, and what to do."""
    sigma = float(np.nanmedian(lens.sigma_px))
    figures = (
        f"{name}: {len(lens.views)} views, residual {lens.rms_px:.2f} px, projection uncertainty {sigma:.2f} px, "
        f"board in {lens.coverage.share():.0%} of the image"
    )
    rejected = [f"{len(lens.rejected)} views rejected as outliers"] if lens.rejected else []
    return "; ".join([figures, *rejected, *lens.warnings(), "accept or discard it"])


def describe_lens(rig: Rig | None, name: str) -> str:
    """What is known about a camera's lens. The rig may come from the network: its `calibration` holds anything."""
    camera = rig.cameras.get(name) if rig is not None else None
    if rig is None or camera is None:
        return "no lens yet: the wand calibration starts from a nominal one of 60 degrees; a board is more precise"
    angle = math.degrees(2 * math.atan(camera.width / (2 * camera.fx)))
    sigma = f" \N{PLUS-MINUS SIGN} {camera.lens_sigma[0]:.1f}" if camera.lens_sigma else ""
    text = f"{camera.model}, focal length {camera.fx:.1f}{sigma} px"
    text += f", {angle:.0f} degrees wide" if camera.model == "pinhole" else ""
    return f"{text}; {_origin(rig.calibration, name)}"


def _origin(calibration: dict[str, Any], name: str) -> str:
    lenses = calibration.get("lenses")
    entry = lenses.get(name) if isinstance(lenses, dict) else None
    if not isinstance(entry, dict):
        return "not calibrated with a board"
    date, residual = str(entry.get("date", ""))[:10], entry.get("residual_px")
    figure = f", residual {residual:.2f} px" if isinstance(residual, float) else ""
    return f"calibrated with a board{f' on {date}' if date else ''}{figure}"
