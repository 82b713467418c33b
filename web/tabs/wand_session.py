# SPDX-License-Identifier: BSD-3-Clause
"""Calibrates the cameras from the page with a wand; `python -m calib wand --live` does so in a terminal."""

import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import viser

from calib.intrinsics.nominal_lens import load_known_lenses, with_nominal_lenses
from calib.live.camera_sizes import running_camera_sizes
from calib.live.wand_session import SessionProgress, WandSession, run_wand_session
from calib.rig.recording import save_wand_recording, wand_recording_path
from calib.rig.rig import Rig, load_rig
from camera_node.config import load_yaml
from camera_node.geometry.body import Body
from web.colours import PREVIEW
from web.condition import next_step
from web.errors import WebError
from web.feed import ArenaState
from web.html_tables import Column, HtmlTable, TableRow
from web.scene.cameras import CameraDrawing
from web.subscription import Subscription
from web.tabs.rig_change import CalibrationFiles, apply_rig
from web.widgets import ActionButton, Answer, LongAction, set_content

SOLVE_S = 600.0  # limit for `calib wand`
CLOSE_S = 5.0  # for the recording to be saved when the page closes
WAND_COLUMNS = (
    Column("camera"),
    Column("frames", "", "frames in which the camera saw the wand"),
    Column("image", "", "part of the image in which roundels were seen"),
    Column("shared", "", "part of the image area shared with other cameras in which the wand was used"),
)
LABELS = ("Start wand session", "End wand session")


class WandSessionPanel:
    """The panel's folder "Wand": records a wand session, then calibrates the cameras from it."""

    def __init__(
        self, server: viser.ViserServer, subscription: Subscription, files: CalibrationFiles
    ) -> None:
        self._subscription, self._files = subscription, files
        with server.gui.add_folder("Wand"):
            self._answer = Answer(server.gui)
            self._session = LongAction(server.gui, LABELS, self._calibrate, self._answer)
            self._accept = ActionButton(server.gui, "Accept the calibration", self.accept, self._answer)
            self._discard = ActionButton(server.gui, "Discard it", self.discard, self._answer)
            self._cameras = server.gui.add_html("")
        self._candidate: Rig | None = None
        self._preview = CameraDrawing(server.scene, "/candidate", PREVIEW)

    def update(self, state: ArenaState) -> None:
        """Enable the button while cameras send, and colour it while it is the next step."""
        step = next_step(state)
        is_next = step == "calibrate" and self._candidate is None
        self._session.show(enabled=step != "cameras", primary=is_next)
        is_ready = self._candidate is not None and not self._session.is_running
        self._accept.show(enabled=is_ready, primary=is_ready)
        self._discard.show(enabled=is_ready)

    def accept(self) -> str:
        """Write the calibrated rig and have the server use it; returns the outcome.

        Raises:
            WebError: there is none.
            CalibrationError, ConfigError: the file can't be written.
        """
        candidate = self._candidate
        if candidate is None:
            raise WebError("there is no calibration to accept; record a wand first")
        outcome = apply_rig(self._subscription, self._files, candidate)
        self._forget()
        return f"{describe_calibration(candidate.calibration)}; {outcome}"

    def discard(self) -> str:
        """Forget the calibrated rig; the recording stays."""
        self._forget()
        return f"discarded; the recording is {wand_recording_path(self._files.rig)}"

    def _forget(self) -> None:
        self._candidate = None
        self._preview.draw(None)
        self._files.candidate.unlink(missing_ok=True)

    def close(self) -> None:
        """End the session and save its recording, without calibrating."""
        self._session.close(CLOSE_S)

    def _calibrate(self, end: threading.Event) -> str:
        self._forget()
        try:
            return self._record_and_calibrate(end)
        finally:
            if self._candidate is None:  # the session failed: the trials' poses in the scene are void
                self._preview.draw(None)

    def _record_and_calibrate(self, end: threading.Event) -> str:
        session, arena, files = self._subscription.session, self._subscription.feed.keys.arena, self._files
        wand = load_yaml(files.wand, Body)
        rig, _ = with_nominal_lenses(load_known_lenses(files.rig), running_camera_sizes(session, arena))
        settings = WandSession(rig=rig, wand=wand)
        collected, reason = run_wand_session(session, arena, settings, self._show, end)
        self._session.handle.disabled = True
        recording = wand_recording_path(files.rig)
        save_wand_recording(recording, arena, collected.messages)
        if self._session.is_closed:
            return ""
        self._answer.show(f"wand session ended: {reason}; calibrating")
        calibrate_cameras(recording, files)
        self._candidate = load_rig(files.candidate)
        self._preview.draw(self._candidate)
        return (
            f"{describe_calibration(self._candidate.calibration)}; the new poses are yellow in the scene: accept or "
            "discard them"
        )

    def _show(self, progress: SessionProgress) -> None:
        rows = [TableRow((*rest, used), "ok" if used else "warn") for *rest, used, _ in progress.cells()]
        table = HtmlTable(WAND_COLUMNS, rows, "no roundel yet")
        set_content(self._cameras, table.html())
        self._answer.show(f"{progress.summary}: {progress.advice}")
        if progress.trial is not None and progress.trial.rig is not None:
            self._preview.draw(progress.trial.rig)


def calibrate_cameras(recording: Path, files: CalibrationFiles) -> None:
    """Run `calib wand` on a recording, in its own process because GTSAM holds the GIL; it writes the
    candidate file.

    Raises:
        WebError: it failed, with its error message.
    """
    files.candidate.unlink(missing_ok=True)  # of a session without a decision
    options = ["--recording", recording, "--wand", files.wand, "--rig", files.rig, "--out", files.candidate]
    command = [sys.executable, "-m", "calib", "wand", *map(str, options)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SOLVE_S, check=False)
    except subprocess.TimeoutExpired:
        raise WebError(
            f"the calibration did not end within {SOLVE_S:.0f} s; the recording is {recording}"
        ) from None
    if done.returncode:
        error = done.stderr.strip().removeprefix("error: ") or f"calib wand ended with {done.returncode}"
        raise WebError(f"{error}; the recording is {recording}")


def describe_calibration(calibration: dict[str, Any]) -> str:
    """Describe the quality of a calibration that `calib wand` wrote, with instructions for the user."""
    text = calibration.get("because", "the cameras are calibrated")
    if expected := calibration.get("expected_mm"):
        text += f"; expected error {expected['median']:.1f} mm, at most {expected['worst']:.1f} mm"
    for name, jump in calibration.get("clock_jump", {}).items():
        text += (
            f"; the clock of {name} jumped by {jump['ms']:.0f} ms: "
            "make sure that no program sets it, and record a new wand session"
        )
    return text
