# SPDX-License-Identifier: BSD-3-Clause
"""A wave of the wand, begun and followed in the page; `python -m calib wand --live` is the same on a terminal."""

import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import viser

from calib.live.collect import publish_rig
from calib.live.wand_session import SessionProgress, WandSession, run_wand_session
from calib.rig.recording import save_wand_recording, wand_recording_path
from calib.rig.rig import load_rig
from camera_node.config import load_yaml
from camera_node.errors import RoundelError
from camera_node.geometry.body import Body
from web.errors import WebError
from web.panel import plain, write
from web.subscription import Subscription
from web.tables import Row, Table

SOLVE_S = 600.0  # for the cameras to be placed, at the most
CLOSE_S = 5.0  # for a wave to be written when the page ends
WAVE, END = "Wave the wand", "End the wave"


@dataclass(frozen=True)
class Files:
    """What a wave is for: the rig, whose lenses are read and which is written anew, and the wand."""

    rig: Path
    wand: Path

    def check(self) -> None:
        """Raise ConfigError or CalibrationError where one is missing or broken."""
        load_rig(self.rig)
        load_yaml(self.wand, Body)


class Calibrating:
    """The panel's folder "Calibrate"."""

    def __init__(self, server: viser.ViserServer, subscription: Subscription, files: Files) -> None:
        self._subscription, self._files = subscription, files
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._thread: threading.Thread | None = None
        self._closed = False
        with server.gui.add_folder("Calibrate"):
            self._button = server.gui.add_button(WAVE)
            self._answer = server.gui.add_markdown("")
            self._seen = server.gui.add_html("")
        self._button.on_click(lambda _: self.press())

    def press(self) -> None:
        """Begin a wave, or end the one that goes on; while cameras are placed, nothing."""
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                self._ended.set()
                return
            self._ended.clear()
            self._button.label = END
            self._thread = threading.Thread(target=self._run, name="wave", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """End a wave, which is kept; nothing is placed by it."""
        with self._lock:
            self._closed = True
            self._ended.set()
        if self._thread is not None:
            self._thread.join(CLOSE_S)

    def _run(self) -> None:
        try:
            self._tell(self._calibrate())
        except RoundelError as error:
            self._tell(str(error))
        except Exception as error:  # whatever it is, the person who waved must hear of it
            self._tell(f"the calibration failed: {error!r}")
        finally:
            self._button.label, self._button.disabled = WAVE, False

    def _calibrate(self) -> str:
        session, arena, files = self._subscription.session, self._subscription.feed.keys.arena, self._files
        rig, wand = load_rig(files.rig), load_yaml(files.wand, Body)
        settings = WandSession(rig=rig, wand=wand)
        heard, why = run_wand_session(session, arena, settings, self._show, self._ended)
        self._button.disabled = True
        kept = wand_recording_path(files.rig)
        save_wand_recording(kept, arena, heard.messages)
        if self._closed:
            return ""
        self._tell(f"the wave ended: {why}; placing the cameras")
        place_cameras(kept, files)
        rig = load_rig(files.rig)
        publish_rig(session, arena, rig)
        taken = self._subscription.feed.latest().server_alive
        return describe(rig.calibration) + (
            "" if taken else f"; no server is there to take it: give it {files.rig}"
        )

    def _show(self, told: SessionProgress) -> None:
        rows = [Row((*rest, used), "ok" if used else "warn") for *rest, used, _ in told.cells()]
        write(self._seen, Table(("camera", "frames", "image", "shared part"), rows, "no roundel yet").html())
        self._tell(f"{told.summary}: {told.advice}")

    def _tell(self, text: str) -> None:
        write(self._answer, plain(text))


def place_cameras(recording: Path, files: Files) -> None:
    """Have `calib wand` write the rig anew from a kept wave, in a process of its own: GTSAM would halt the page.

    Raises:
        WebError: it can't; in its own words.
    """
    words = ["--recording", recording, "--wand", files.wand, "--rig", files.rig, "--out", files.rig]
    command = [sys.executable, "-m", "calib", "wand", *map(str, words)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SOLVE_S, check=False)
    except subprocess.TimeoutExpired:
        raise WebError(
            f"the cameras were not placed within {SOLVE_S:.0f} s; the wave is {recording}"
        ) from None
    if done.returncode:
        said = done.stderr.strip().removeprefix("error: ") or f"calib wand ended with {done.returncode}"
        raise WebError(f"{said}; the wave is kept as {recording}")


def describe(calibration: dict[str, Any]) -> str:
    """What a person has to know of a rig that `calib wand` wrote."""
    expected = calibration.get("expected_mm")
    errors = (
        f"; expected error {expected['median']:.1f} mm, {expected['worst']:.1f} mm at the worst"
        if expected
        else ""
    )
    jumps = "".join(
        f"; the clock of {name} jumped by {jump['ms']:.0f} ms: see that nothing sets it, and wave again"
        for name, jump in calibration.get("clock_jump", {}).items()
    )
    return f"{calibration.get('because', 'the cameras are placed')}{errors}{jumps}"
