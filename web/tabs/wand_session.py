# SPDX-License-Identifier: BSD-3-Clause
"""Calibrates the cameras from the page with a wand; `python -m calib wand --live` does so in a terminal."""

import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import viser

from calib.intrinsics.nominal_lens import load_known_lenses, with_nominal_lenses
from calib.live.camera_sizes import running_camera_sizes
from calib.live.rig_requests import set_rig
from calib.live.wand_session import SessionProgress, WandSession, run_wand_session
from calib.rig.recording import save_wand_recording, wand_recording_path
from calib.rig.rig import Rig, load_rig, save_rig
from camera_node.config import load_yaml
from camera_node.errors import RoundelError
from camera_node.geometry.body import Body
from web.colours import PREVIEW
from web.condition import next_step
from web.errors import WebError
from web.feed import ArenaState
from web.html_tables import Column, HtmlTable, TableRow
from web.scene.cameras import CameraDrawing
from web.subscription import Subscription
from web.widgets import GREY, PRIMARY, ActionButton, Answer, set_content, set_property

SOLVE_S = 600.0  # limit for `calib wand`
CLOSE_S = 5.0  # for the recording to be saved when the page closes
WAND_COLUMNS = (
    Column("camera"),
    Column("frames", "", "frames in which the camera saw the wand"),
    Column("image", "", "part of the image in which roundels were seen"),
    Column("shared", "", "part of the image area shared with other cameras in which the wand was used"),
)
START, END = "Start wand session", "End wand session"


@dataclass(frozen=True)
class CalibrationFiles:
    """The rig, whose intrinsics are read and whose extrinsics are written, and the wand."""

    rig: Path
    wand: Path

    @property
    def candidate(self) -> Path:
        """The rig that is calibrated but not accepted yet, beside the rig."""
        return self.rig.with_name(f"{self.rig.stem}.candidate.yaml")

    def check(self) -> None:
        """Raise ConfigError or CalibrationError if a file is missing or invalid."""
        load_known_lenses(self.rig)
        load_yaml(self.wand, Body)


class WandSessionPanel:
    """The panel's folder "Wand": records a wand session, then calibrates the cameras from it."""

    def __init__(
        self, server: viser.ViserServer, subscription: Subscription, files: CalibrationFiles
    ) -> None:
        self._subscription, self._files = subscription, files
        self._lock, self._end_requested = threading.Lock(), threading.Event()
        self._thread: threading.Thread | None = None
        self._closed = False
        with server.gui.add_folder("Wand"):
            self._button = server.gui.add_button(START, color=GREY)
            self._answer = Answer(server.gui)
            self._accept = ActionButton(server.gui, "Accept the calibration", self.accept, self._answer)
            self._discard = ActionButton(server.gui, "Discard it", self.discard, self._answer)
            self._cameras = server.gui.add_html("")
        self._candidate: Rig | None = None
        self._preview = CameraDrawing(server.scene, "/candidate", PREVIEW)
        self._button.on_click(lambda _: self.toggle())

    def update(self, state: ArenaState) -> None:
        """Enable the button while cameras send, and colour it while it is the next step."""
        step = next_step(state)
        is_running = self._thread is not None and self._thread.is_alive()
        is_next = step == "calibrate" and self._candidate is None
        set_property(self._button, "color", PRIMARY if is_running or is_next else GREY)
        if not is_running:
            set_property(self._button, "disabled", step == "cameras")
        is_ready = self._candidate is not None and not is_running
        self._accept.show(enabled=is_ready, primary=is_ready)
        self._discard.show(enabled=is_ready)

    def toggle(self) -> None:
        """Start a wand session, or end the current one."""
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                self._end_requested.set()
                return
            self._end_requested.clear()
            self._forget()
            self._button.label = END
            self._thread = threading.Thread(target=self._run, name="wand session", daemon=True)
            self._thread.start()

    def accept(self) -> str:
        """Write the calibrated rig and have the server use it; returns the outcome.

        Raises:
            WebError: there is none.
            CalibrationError, ConfigError: the file can't be written.
        """
        candidate = self._candidate
        if candidate is None:
            raise WebError("there is no calibration to accept; record a wand first")
        save_rig(candidate, self._files.rig)
        self._forget()
        outcome = describe_calibration(candidate.calibration)
        try:
            set_rig(self._subscription.session, self._subscription.feed.keys.arena, candidate, "web")
        except RoundelError as error:
            return f"{outcome}; {self._files.rig} is written, but not in force: {error}"
        return f"{outcome}; in force on the server"

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
        with self._lock:
            self._closed = True
            self._end_requested.set()
        if self._thread is not None:
            self._thread.join(CLOSE_S)

    def _run(self) -> None:
        try:
            self._answer_with(self._calibrate())
        except RoundelError as error:
            self._answer_with(str(error))
        except Exception as error:  # the page must show any failure to the user
            self._answer_with(f"the calibration failed: {error!r}")
        finally:
            self._button.label, self._button.disabled = START, False
            if self._candidate is None:  # the session failed: the trials' poses in the scene are void
                self._preview.draw(None)

    def _calibrate(self) -> str:
        session, arena, files = self._subscription.session, self._subscription.feed.keys.arena, self._files
        wand = load_yaml(files.wand, Body)
        rig, _ = with_nominal_lenses(load_known_lenses(files.rig), running_camera_sizes(session, arena))
        settings = WandSession(rig=rig, wand=wand)
        collected, reason = run_wand_session(session, arena, settings, self._show, self._end_requested)
        self._button.disabled = True
        recording = wand_recording_path(files.rig)
        save_wand_recording(recording, arena, collected.messages)
        if self._closed:
            return ""
        self._answer_with(f"wand session ended: {reason}; calibrating")
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
        self._answer_with(f"{progress.summary}: {progress.advice}")
        if progress.trial is not None and progress.trial.rig is not None:
            self._preview.draw(progress.trial.rig)

    def _answer_with(self, text: str) -> None:
        self._answer.show(text)


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
