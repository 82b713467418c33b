# SPDX-License-Identifier: BSD-3-Clause
"""Calibrates the cameras from the page with a wand; `roundel calibrate wand --live` does so in a terminal."""

import tempfile
import threading
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import viser

from calib.live.collect import running_camera_sizes
from calib.live.live_session import SessionProgress, run_wand_session
from calib.live.trials import WandSession
from calib.live.wand_position import locate_wand
from calib.rig.recording import save_wand_recording, wand_recording_path
from calib.rig.rig import Rig, load_rig, save_rig
from calib.rig.rig_messages import moved_mm
from calib.wand.nominal_lens import load_known_lenses, with_nominal_lenses
from camera_node.foundation.arrays import Array
from camera_node.foundation.config import load_yaml
from camera_node.geometry.body import Body, PrintedWand
from web.colours import PREVIEW, WAND_TRAIL
from web.commands import run_program
from web.condition import next_step
from web.errors import WebError
from web.html_tables import Column, HtmlTable, TableRow
from web.scene.camera_frustums import CameraDrawing
from web.scene.markers import add_points, show_points
from web.state.feed import ArenaState
from web.state.subscription import Subscription
from web.tabs.calibration_panels import CalibrationFiles, apply_rig, current_rig
from web.widgets import Answer, Decision, LongAction, set_content

SOLVE_S = 600.0  # limit for `roundel calibrate wand`
WAND_COLUMNS = (
    Column("camera"),
    Column("frames", "", "frames in which the camera saw the wand"),
    Column("image", "", "part of the image in which roundels were seen"),
    Column("shared", "", "part of the image area shared with other cameras in which the wand was used"),
)
ALL = "all cameras"
ONLY_ADVICE = "wave the wand in front of {0} and its neighbours for 10 to 20 s, then end the session"
LABELS = ("Start wand session", "End wand session")
MAX_TRAIL = 1500  # places; at five a second, a session of five minutes
MARKER_M, TRAIL_M, LINE_M = 0.05, 0.025, 0.02


class WandSessionPanel:
    """The panel's folder "Wand": records a wand session, then calibrates the cameras from it."""

    def __init__(
        self, server: viser.ViserServer, subscription: Subscription, files: CalibrationFiles
    ) -> None:
        self._subscription, self._files = subscription, files
        with server.gui.add_folder("Wand"):
            self._which = server.gui.add_dropdown(
                "Calibrate",
                [ALL],
                hint="one camera: it was moved or is new, and the other cameras stay as they are",
            )
            self._answer = Answer(server.gui)
            self.session = LongAction(server.gui, LABELS, self._calibrate, self._answer)
            self.decision = Decision(server.gui, "the calibration", self._use, self._forget, self._answer)
            self._cameras = server.gui.add_html("")
        self._preview = CameraDrawing(server.scene, "/candidate", PREVIEW)
        self._wand = WandDrawing(server.scene)
        self._trial: Rig | None = None

    def next_action(self) -> str:
        """What the operator should do in the session, or with its result; empty if there is none."""
        if self.session.is_running and self.session.handle.disabled:
            return "the wand session has ended: wait for its calibration"
        if self.session.is_running:
            return "a wand session runs: wave where the table in Calibrate says"
        is_ready = self.decision.result is not None
        return "a new calibration is ready: decide in Calibrate whether to use it" if is_ready else ""

    def update(self, state: ArenaState) -> None:
        """Enable the button while cameras send, and colour it while it is the next step."""
        step = next_step(state)
        known = state.rig.cameras if state.rig is not None and state.rig.placed() else {}
        names = (ALL, *sorted(known.keys() & state.cameras.keys()))
        if names != tuple(self._which.options) and not self.session.is_running:
            self._which.options = names
        is_next = step == "calibrate" and self.decision.result is None
        self.session.show(enabled=step != "cameras", primary=is_next)
        self.decision.show(enabled=not self.session.is_running)

    def _use(self, candidate: Rig) -> str:
        """Write the calibrated rig and have the server use it; raises as `apply_rig`."""
        outcome = apply_rig(self._subscription, self._files, candidate)
        return f"{describe_calibration(candidate.calibration)}; {outcome}"

    def _forget(self) -> str:
        set_content(self._cameras, "")  # its advice is for the session that is over
        self._preview.draw(None)
        self._files.candidate.unlink(missing_ok=True)
        return f"; the recording is {wand_recording_path(self._files.rig)}"

    def close(self) -> None:
        """End the session and save its recording, without calibrating."""
        self.session.close()

    def _calibrate(self, end: threading.Event) -> str:
        self.decision.clear()
        try:
            return self._record_and_calibrate(end, str(self._which.value))
        finally:
            self._wand.clear()
            if self.decision.result is None:  # the session failed: the trials' poses in the scene are void
                self._preview.draw(None)

    def _record_and_calibrate(self, end: threading.Event, only: str) -> str:
        session, arena, files = self._subscription.session, self._subscription.feed.keys.arena, self._files
        wand = load_yaml(files.wand, PrintedWand)
        before = current_rig(self._subscription, files)
        if only == ALL:
            lenses, sizes = load_known_lenses(files.rig), running_camera_sizes(session, arena)
            settings = WandSession(rig=with_nominal_lenses(lenses, sizes)[0], wand=wand)
        else:
            settings = WandSession(rig=before, wand=wand, trials=False, stops_itself=False)
        show = partial(self._show, settings, "" if only == ALL else ONLY_ADVICE.format(only))
        collected, reason = run_wand_session(session, arena, settings, show, end)
        self.session.handle.disabled = True
        recording = wand_recording_path(files.rig)
        save_wand_recording(recording, arena, collected.messages)
        if self.session.is_closed:
            return ""
        self._answer.show(f"wand session ended: {reason}; calibrating")
        if only == ALL:
            calibrate_cameras(recording, files)
        else:
            recalibrate_one(recording, files, before, only)
        candidate = load_rig(files.candidate)
        self.decision.result = candidate
        self._preview.draw(candidate)
        text = (
            describe_calibration(candidate.calibration)
            if only == ALL
            else describe_move(before, candidate, only)
        )
        return f"{text}; the new poses are yellow in the scene: accept or discard them"

    def _show(self, settings: WandSession, advice: str, progress: SessionProgress) -> None:
        where = progress.trial.advice if progress.trial is not None else {}
        rows = [
            TableRow((name, *rest, used), "ok" if used else "warn", where.get(name, ""))
            for name, *rest, used, _ in progress.cells()
        ]
        set_content(self._cameras, HtmlTable(WAND_COLUMNS, rows, "no roundel yet").html())
        self._answer.show(f"{progress.summary}: {advice or progress.advice}")
        rig = settings.rig if advice else progress.trial.rig if progress.trial is not None else None
        if rig is not None:
            self._draw(rig, settings.wand, is_trial=not advice)

    def _draw(self, rig: Rig, wand: Body, is_trial: bool) -> None:
        """Draw the wand, and the cameras of a trial; the next trial's world differs, so the trail begins again."""
        if is_trial and rig is not self._trial:
            self._trial = rig
            self._wand.clear()
            self._preview.draw(rig)
        latest = self._subscription.feed.state().detections
        self._wand.draw(locate_wand(rig.placed(), wand, latest))


def calibrate_cameras(recording: Path, files: CalibrationFiles) -> None:
    """Run `roundel calibrate wand` on a recording, in its own process because GTSAM holds the GIL; it writes the
    candidate file.

    Raises:
        WebError: it failed, with its error message.
    """
    _run_calib(recording, files, ["--rig", str(files.rig)])


def recalibrate_one(recording: Path, files: CalibrationFiles, rig: Rig, name: str) -> None:
    """Like `calibrate_cameras`, for one camera of a rig: `roundel calibrate wand --only`."""
    with tempfile.TemporaryDirectory(prefix="roundel-rig-") as folder:
        path = Path(folder) / "rig.yaml"
        save_rig(rig, path)
        _run_calib(recording, files, ["--rig", str(path), "--only", name])


def _run_calib(recording: Path, files: CalibrationFiles, rest: list[str]) -> None:
    files.candidate.unlink(missing_ok=True)  # of a session without a decision
    options = ["--recording", recording, "--wand", files.wand, "--out", files.candidate, *rest]
    try:
        run_program("calib", "wand", *options, timeout_s=SOLVE_S)
    except WebError as error:
        raise WebError(f"{error}; the recording is {recording}") from None


def describe_move(before: Rig, after: Rig, name: str) -> str:
    """How far a recalibrated camera moved."""
    new, old = after.cameras[name], before.cameras.get(name)
    if old is None or old.T_world_cam is None:
        return f"{name} is placed"
    return f"{name} moved by {moved_mm(old, new):.1f} mm"


def describe_calibration(calibration: dict[str, Any]) -> str:
    """Describe the quality of a calibration that `roundel calibrate wand` wrote, with instructions for the user."""
    text = calibration.get("because", "the cameras are calibrated")
    if expected := calibration.get("expected_mm"):
        text += f"; expected error {expected['median']:.1f} mm, at most {expected['worst']:.1f} mm"
    for name, jump in calibration.get("clock_jump", {}).items():
        text += (
            f"; the clock of {name} jumped by {jump['ms']:.0f} ms: "
            "make sure that no program sets it, and record a new wand session"
        )
    return text


class WandDrawing:
    """The wand in the scene and its trail; nothing before the first `draw`."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._trail = np.empty((0, 3))
        self._markers = add_points(scene, "/wand/markers", PREVIEW, MARKER_M)
        self._path = add_points(scene, "/wand/trail", WAND_TRAIL, TRAIL_M)
        self._line = scene.add_line_segments(
            "/wand/line", np.zeros((1, 2, 3), np.float32), PREVIEW, thickness=LINE_M, visible=False
        )

    @property
    def n_places(self) -> int:
        """Number of places in the trail."""
        return len(self._trail)

    def clear(self) -> None:
        """Hide the wand and forget its trail."""
        self._trail = np.empty((0, 3))
        self.draw(None)

    def draw(self, markers: Array | None) -> None:
        """Draw the markers (M, 3), world, of which those that are NaN were not seen; None hides the wand."""
        points = np.empty((0, 3)) if markers is None else markers[np.isfinite(markers[:, 0])]
        if len(points):
            self._trail = np.vstack([self._trail, points.mean(axis=0)])[-MAX_TRAIL:]
        show_points(self._markers, points)
        show_points(self._path, self._trail)
        self._line.visible = len(points) > 1
        if len(points) > 1:
            ends = points[[np.linalg.norm(points - points[0], axis=1).argmax(), 0]]
            self._line.points = ends[None].astype(np.float32)
