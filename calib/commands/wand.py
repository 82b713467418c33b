# SPDX-License-Identifier: BSD-3-Clause
"""`calib wand`: calibrates camera poses from a wand that is waved in front of the cameras."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
from rich.live import Live
from zenoh import Session

from calib.commands.connection import Connection, Server
from calib.commands.inputs import WandOptions, require_positive
from calib.commands.output import check_folder, provenance, save_maps, write_rig
from calib.commands.report import print_recalibration, print_report, show_progress
from calib.live.collect import CollectedFrames
from calib.live.wand_session import MAX_SECONDS, WandSession, run_wand_session
from calib.rig.recording import save_wand_recording, wand_recording_path
from calib.rig.rig import Rig, load_rig
from calib.rig.wand_file import load_wand
from calib.wand.calibrate import calibrate
from calib.wand.quality.grade import assess
from calib.wand.recalibration import recalibrate_camera
from calib.wand.scale import Distance
from camera_node.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from camera_node.terminal import console, progress_console, say

PROGRAM = "calib wand"


@dataclass(frozen=True, kw_only=True)
class Wand(WandOptions):
    """Calibrate camera poses from a wand that is waved in front of the cameras."""

    rig: Path
    """Intrinsics of every camera; its poses are used with --only."""
    out: Path
    """The file for the rig with poses; a previous file is saved as rig.1.yaml, ..."""
    live: bool = False
    """Collect from the running cameras, save the wand recording beside --out (rig.wave.mcap), and have the server use
    the result."""
    seconds: float | None = None
    """Collect for this long; by default until more frames would not improve the result, at most three minutes."""
    only: str | None = None
    """Calibrate the pose of this camera only, from a short recording; the other cameras keep theirs."""
    server: Server = field(default_factory=Connection)

    def execute(self) -> None:
        """Calibrate and write the rig; nothing is written unless two cameras or more are placed."""
        check_folder(self.out)
        self.require_recording(live=self.live)
        require_positive(self.seconds)
        rig, wand = load_rig(self.rig), load_wand(self.wand)
        if self.distance is not None and self.only is not None:
            raise ConfigError(
                "--distance and --only exclude each other: the rig's other cameras keep its scale"
            )
        distance = self.measured_distance(rig)
        if self.live:
            self._calibrate_live(rig, wand, distance)
        else:
            placed = self._calibrate(rig, wand, self.read_recording(rig, wand), distance)
            self.server.conclude(placed, self.out, PROGRAM, live=False)

    def _calibrate(
        self, rig: Rig, wand: Body, messages: Sequence[Detections], distance: Distance | None
    ) -> Rig:
        placed = (
            self._calibrate_all(rig, wand, messages, distance)
            if self.only is None
            else self._calibrate_one(rig, wand, messages, self.only)
        )
        write_rig(placed, self.out)
        return placed

    def _calibrate_all(
        self, rig: Rig, wand: Body, messages: Sequence[Detections], distance: Distance | None
    ) -> Rig:
        with progress_console().status("calibrating camera poses"):
            result = calibrate(rig, wand, messages, distance, self.synchronised)
        quality = assess(result, wand, self.height)
        print_report(result, quality)
        if self.maps is not None:
            save_maps(self.maps, result, quality)
        figures = {**provenance(), **quality.as_dict(), **result.as_dict()}
        if "lenses" in rig.calibration:
            figures["lenses"] = rig.calibration["lenses"]
        return msgspec.structs.replace(result.rig, calibration=figures)

    def _calibrate_one(self, rig: Rig, wand: Body, messages: Sequence[Detections], name: str) -> Rig:
        with progress_console().status(f"calibrating the pose of {name}"):
            result = recalibrate_camera(rig, wand, messages, name, self.synchronised)
        print_recalibration(result)
        figures = result.rig.calibration | {"only": {"camera": name, **provenance()}}
        return msgspec.structs.replace(result.rig, calibration=figures)

    def _calibrate_live(self, rig: Rig, wand: Body, distance: Distance | None) -> None:
        with self.server.open() as session:
            collected, reason = self._collect(session, rig, wand, distance)
        say(f"the wand session ended: {reason}")
        if collected.invalid:
            say(f"warning: {collected.invalid} invalid messages were skipped")
        recording = self._save(collected.messages)
        try:
            placed = self._calibrate(rig, wand, collected.messages, distance)
        except BaseException:
            if recording is not None:
                say(f"the wand recording is saved; to calibrate from it again: {self._command(recording)}")
            raise
        self.server.put_in_force(placed, self.out, PROGRAM)

    def _collect(
        self, session: Session, rig: Rig, wand: Body, distance: Distance | None
    ) -> tuple[CollectedFrames, str]:
        # With a fixed duration and no terminal, trials would only take processor time from the cameras.
        trials = self.seconds is None or console().is_terminal
        settings = WandSession(
            rig=rig,
            wand=wand,
            distance=distance,
            seconds=self.seconds or MAX_SECONDS,
            trials=trials,
            stops_itself=trials and self.seconds is None,
        )
        with Live(console=progress_console(), transient=True) as live:
            return run_wand_session(
                session,
                self.server.arena,
                settings,
                lambda progress: live.update(show_progress(progress)),
            )

    def _save(self, messages: Sequence[Detections]) -> Path | None:
        """Save the recording before the calibration, so that no failure there can lose it."""
        path = wand_recording_path(self.out)
        try:
            backup = save_wand_recording(path, self.server.arena, messages)
        except ConfigError as error:
            say(f"warning: the wand recording is not saved: {error}")
            return None
        previous = f"; the previous one is saved as {backup.name}" if backup else ""
        say(f"saved the wand recording as {path}{previous}")
        return path

    def _command(self, recording: Path) -> str:
        """The command that calibrates from a saved recording with the options of this one."""
        options = {"recording": recording, "wand": self.wand, "rig": self.rig, "out": self.out}
        options |= {"only": self.only, "height": self.height, "maps": self.maps}
        flags = ["--synchronised"] * self.synchronised
        words = [
            word for name, value in options.items() if value is not None for word in (f"--{name}", value)
        ]
        if self.distance is not None:
            words += ["--distance", *self.distance, "--distance-sigma", self.distance_sigma]
        return shlex.join(["python", "-m", "calib", "wand", *map(str, words), *flags])
