# SPDX-License-Identifier: BSD-3-Clause
"""`roundel calibrate wand`: calibrates camera poses from a wand that is waved in front of the cameras."""

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text
from zenoh import Session

from calib.commands.inputs import WandOptions, require_positive
from calib.commands.output import check_folder, conclude, provenance, put_in_force, write_rig
from calib.commands.printed_report import print_recalibration, print_report, save_maps
from calib.errors import CalibrationError
from calib.live.collect import CollectedFrames, running_camera_sizes
from calib.live.live_session import SessionProgress, run_wand_session
from calib.live.trials import MAX_SECONDS, WandSession
from calib.rig.recording import save_wand_recording, wand_recording_path
from calib.rig.rig import Rig, load_rig
from calib.rig.wand_file import load_wand
from calib.wand.bundle_adjustment.covariance import widen_lenses
from calib.wand.calibrate import calibrate
from calib.wand.nominal_lens import FIELD_OF_VIEW_DEG, load_known_lenses, with_nominal_lenses
from calib.wand.quality.grade import assess
from calib.wand.scale import Distance
from calib.wand.single_camera import recalibrate_camera
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import console, progress_console, say
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions
from camera_node.sources.recorded_detections import read_observations

PROGRAM = "roundel calibrate wand"
VIEWS_DEG = (5, 150)  # of lenses that have a pinhole model


def add_nominal_lenses(
    rig: Rig, sizes: Mapping[str, tuple[int, int]], degrees: float = FIELD_OF_VIEW_DEG
) -> Rig:
    """The rig with a nominal lens of this horizontal field of view for each camera that it lacks; prints which ones.

    Raises:
        CalibrationError: there is no camera at all.
    """
    completed, missing = with_nominal_lenses(rig, sizes, degrees)
    if missing:
        say(f"no lens known of {', '.join(missing)}: starting from a field of view of {degrees:g} degrees")
    if not completed.cameras:
        raise CalibrationError("no camera publishes; start cameras with roundel camera, or give --rig")
    return completed


@dataclass(frozen=True, kw_only=True)
class Wand(WandOptions):
    """Calibrate camera poses from a wand that is waved in front of the cameras."""

    rig: Path
    """Intrinsics of the cameras; its poses are used with --only. With --live, --recording, --field-of-view or
    --image-size, the lens of a camera that it lacks is found from a nominal one; the file may be missing."""
    out: Path
    """The file for the rig with poses; a previous file is saved as rig.1.yaml, ..."""
    live: bool = False
    """Collect from the running cameras, save the wand recording beside --out (rig.wave.mcap), and have the server use
    the result."""
    seconds: float | None = None
    """Collect for this long; by default until more frames would not improve the result, at most three minutes."""
    only: str | None = None
    """Calibrate the pose of this camera only, from a short recording; the other cameras keep theirs."""
    background: Path | None = None
    """Points beside the wand, at unknown places, that stand still or move: a CSV as for --observations, in which marker
    is the number of the point, the same in all cameras. They make the cameras accurate where the wand is not waved."""
    widen_lenses: float = 1.0
    """Multiply the standard deviations of the lenses by this, 1 or more: for lenses that changed since they were
    calibrated, or that are farther off than usual."""
    field_of_view: float | None = None
    """Horizontal field of view, degrees, from which lenses that --rig lacks are found; 60 unless given. It may be wrong
    by a factor of two."""
    image_size: tuple[int, int] | None = None
    """Width and height of the images of cameras that --rig lacks, for --observations, which does not state them."""
    connection: ConnectionOptions = LOCAL_SERVER

    def run(self) -> None:
        """Calibrate and write the rig; nothing is written unless two cameras or more are placed."""
        check_folder(self.out)
        self.require_recording(live=self.live)
        require_positive(self.seconds)
        if not 1 <= self.widen_lenses < math.inf:
            raise ConfigError(f"--widen-lenses is {self.widen_lenses:g}; it must be 1 or more")
        if not VIEWS_DEG[0] <= self._degrees <= VIEWS_DEG[1]:
            raise ConfigError(
                f"--field-of-view is {self._degrees:g}; it must be between {VIEWS_DEG[0]} and {VIEWS_DEG[1]} degrees"
            )
        rig, wand = self._load_lenses(), load_wand(self.wand)
        if self.distance is not None and self.only is not None:
            raise ConfigError(
                "--distance and --only exclude each other: the rig's other cameras keep its scale"
            )
        if self.background is not None and self.only is not None:
            raise ConfigError("--background and --only exclude each other: calibrate all cameras with it")
        if self.live:
            self._calibrate_live(rig, wand)
            return
        messages = self._with_image_size(rig, self.read_recording(rig, wand, self._may_lack_lenses))
        if self._may_lack_lenses:
            sizes = {m.camera: (m.width, m.height) for m in messages}
            rig = add_nominal_lenses(rig, sizes, self._degrees)
        placed = self._calibrate(rig, wand, messages, self.measured_distance(rig))
        conclude(self.connection, placed, self.out, PROGRAM, live=False)

    def _load_lenses(self) -> Rig:
        """The rig; without cameras if there is no file, and cameras can be added."""
        return load_known_lenses(self.rig) if self._may_lack_lenses else load_rig(self.rig)

    @property
    def _degrees(self) -> float:
        return FIELD_OF_VIEW_DEG if self.field_of_view is None else self.field_of_view

    @property
    def _may_lack_lenses(self) -> bool:
        guessed = self.live or any((self.recording, self.field_of_view, self.image_size))
        return self.only is None and guessed

    def _with_image_size(self, rig: Rig, messages: list[Detections]) -> list[Detections]:
        """The messages with the given image size of cameras that the rig lacks.

        Raises:
            ConfigError: their source states none, and none is given.
        """
        if self.observations is None or not self._may_lack_lenses:
            return messages
        unknown = sorted({m.camera for m in messages} - rig.cameras.keys())
        if not unknown:
            return messages
        if self.image_size is None:
            raise ConfigError(
                f"{self.observations} does not state the size of the images of {', '.join(unknown)}; add --image-size "
                "WIDTH HEIGHT"
            )
        width, height = self.image_size
        if min(width, height) < 1:
            raise ConfigError(f"--image-size is {width} {height}; both must be 1 pixel or more")
        return [
            msgspec.structs.replace(m, width=width, height=height) if m.camera in unknown else m
            for m in messages
        ]

    def _calibrate(
        self, rig: Rig, wand: Body, messages: Sequence[Detections], distance: Distance | None
    ) -> Rig:
        if self.widen_lenses > 1:
            rig = msgspec.structs.replace(rig, cameras=widen_lenses(rig.cameras, self.widen_lenses))
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
            beside = self._read_background(rig)
            result = calibrate(rig, wand, messages, distance, self.synchronised, beside)
        quality = assess(result, wand, self.height)
        print_report(result, quality)
        if self.maps is not None:
            save_maps(self.maps, result, quality)
        figures = {**provenance(), **quality.as_dict(), **result.as_dict()}
        if "lenses" in rig.calibration:
            figures["lenses"] = rig.calibration["lenses"]
        return msgspec.structs.replace(result.rig, calibration=figures)

    def _read_background(self, rig: Rig) -> Sequence[Detections]:
        """The images of the background points.

        Raises:
            ConfigError: the file is not usable.
        """
        if self.background is None:
            return ()
        sizes = {name: (lens.width, lens.height) for name, lens in rig.cameras.items()}
        return read_observations(self.background, sizes, self.fps)

    def _calibrate_one(self, rig: Rig, wand: Body, messages: Sequence[Detections], name: str) -> Rig:
        with progress_console().status(f"calibrating the pose of {name}"):
            result = recalibrate_camera(rig, wand, messages, name, self.synchronised)
        print_recalibration(result)
        figures = result.rig.calibration | {"only": {"camera": name, **provenance()}}
        return msgspec.structs.replace(result.rig, calibration=figures)

    def _calibrate_live(self, rig: Rig, wand: Body) -> None:
        with self.connection.open() as session:
            if self.only is None:
                rig = add_nominal_lenses(
                    rig, running_camera_sizes(session, self.connection.arena), self._degrees
                )
            distance = self.measured_distance(rig)
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
        put_in_force(self.connection, placed, self.out, PROGRAM)

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
            stops_without_wand=self.seconds is None,
        )
        with Live(console=progress_console(), transient=True) as live:
            return run_wand_session(
                session,
                self.connection.arena,
                settings,
                lambda progress: live.update(show_progress(progress)),
            )

    def _save(self, messages: Sequence[Detections]) -> Path | None:
        """Save the recording before the calibration, so that no failure there can lose it."""
        path = wand_recording_path(self.out)
        try:
            backup = save_wand_recording(path, self.connection.arena, messages)
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
        if self.widen_lenses > 1:
            words += ["--widen-lenses", self.widen_lenses]
        if self.distance is not None:
            words += ["--distance", *self.distance, "--distance-sigma", self.distance_sigma]
        return shlex.join(["roundel", "calibrate", "wand", *map(str, words), *flags])


def show_progress(progress: SessionProgress) -> Group:
    """The progress of a session: the frames and the area of each camera, the expected result, and advice."""
    table = Table("camera", "frames", "image covered", "shared area used", "pose error / noise")
    for cells in progress.cells():
        table.add_row(*cells)
    advice = Text(progress.advice, "green" if progress.enough else "yellow")
    return Group(Text(progress.summary, "bold"), table, advice)
