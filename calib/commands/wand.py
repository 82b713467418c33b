# SPDX-License-Identifier: BSD-3-Clause
"""`calib wand`: where cameras stand, by a wand waved before them."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
from rich.console import Console
from rich.live import Live
from zenoh import Session

from calib.commands.choice import require_one
from calib.commands.connection import Connection, Server
from calib.commands.output import check_folder, provenance, save_maps, say, write_rig
from calib.commands.recording import read_recording
from calib.commands.report import print_report, show_progress
from calib.live.collect import CollectedFrames
from calib.live.wand_session import MOST_S, wave
from calib.rig.recording import save_wave, wave_beside
from calib.rig.rig import Rig, load_rig
from calib.wand.calibrate import calibrate
from calib.wand.quality.grade import assess
from calib.wand.recalibration import recalibrate_camera
from calib.wand.scale import SIGMA_M, Distance
from camera_node.config import load_yaml
from camera_node.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from camera_node.terminal import progress_console


@dataclass(frozen=True, kw_only=True)
class Wand:
    """Place the cameras by a wand that was waved before them."""

    wand: Path = Path("configs/wand.yaml")
    """The wand: diameter_m and markers, metres."""
    rig: Path
    """Intrinsics of every camera; poses in it are not used, but with --only."""
    out: Path
    """Where the rig with poses is written; a rig that is there is kept as rig.1.yaml, ..."""
    frames: Path | None = None
    """Detect in <FOLDER>/<camera>/<t_ns>.png|jpg."""
    observations: Path | None = None
    """Or take marker centres from a CSV: t_ns,camera,u,v[,marker]."""
    recording: Path | None = None
    """Or take what --live kept, or python -m fusion record wrote (MCAP)."""
    live: bool = False
    """Or subscribe to the running cameras, and hand them the result; the wave is kept beside --out (rig.wave.mcap)."""
    seconds: float | None = None
    """Wave for so long; without it, until more waving would not help, for three minutes at the most."""
    only: str | None = None
    """Place this camera alone, anew, by a short wave; the rig's others stay where they are."""
    distance: tuple[str, str, float] | None = None
    """Two cameras and the metres between their lenses: the scale for a wand of one marker, else a check of the wand."""
    distance_sigma: float = SIGMA_M
    """Standard deviation of that distance, metres."""
    height: float = 0.1
    """Metres above the floor at which robots carry their roundels: where errors are foretold."""
    maps: Path | None = None
    """A folder for pictures: each camera's residuals and where to wave next, and the errors to expect."""
    server: Server = field(default_factory=Connection)

    def execute(self, console: Console) -> None:
        """Nothing is written unless two cameras or more were placed."""
        check_folder(self.out)
        files = {"--frames FOLDER": self.frames, "--observations CSV": self.observations}
        require_one({**files, "--recording MCAP": self.recording, "--live": self.live})
        if self.seconds is not None and not self.seconds > 0:
            raise ConfigError(f"--seconds is {self.seconds}; it must be above 0")
        rig, wand = load_rig(self.rig), load_yaml(self.wand, Body)
        distance = self._distance(rig)
        if self.live:
            self._run_live(rig, wand, distance, console)
        else:
            messages = read_recording(rig, self.frames, self.observations, wand, self.recording)
            self._place(rig, wand, messages, distance, console)

    def _distance(self, rig: Rig) -> Distance | None:
        if self.distance is not None and self.only is not None:
            raise ConfigError(
                "--distance and --only exclude each other: the rig's other cameras keep its scale"
            )
        return Distance.of(self.distance, self.distance_sigma, list(rig.cameras))

    def _place(
        self,
        rig: Rig,
        wand: Body,
        messages: Sequence[Detections],
        distance: Distance | None,
        console: Console,
    ) -> Rig:
        if self.only is not None:
            return self._place_one(rig, wand, messages, self.only, console)
        with console.status("placing cameras"):
            result = calibrate(rig, wand, messages, distance)
        trust = assess(result, wand, self.height)
        print_report(result, trust, console)
        if self.maps is not None:
            save_maps(self.maps, result, trust, console)
        told = {**provenance(), **trust.as_dict(), **result.as_dict(), **_of_lenses(rig)}
        placed = msgspec.structs.replace(result.rig, calibration=told)
        write_rig(placed, self.out, console)
        return placed

    def _place_one(
        self, rig: Rig, wand: Body, messages: Sequence[Detections], name: str, console: Console
    ) -> Rig:
        with console.status(f"placing {name}"):
            result = recalibrate_camera(rig, wand, messages, name)
        moved = (
            ""
            if result.moved_mm is None
            else f"moved {result.moved_mm:.1f} mm, {result.turned_deg:.2f} degrees; "
        )
        known = f"its place is known to {result.sigma_mm:.1f} mm, residuals {result.residual_px:.2f} px"
        say(console, f"{name}: {moved}{known}")
        told = result.rig.calibration | {"only": {"camera": name, **provenance()}}
        placed = msgspec.structs.replace(result.rig, calibration=told)
        write_rig(placed, self.out, console)
        return placed

    def _run_live(self, rig: Rig, wand: Body, distance: Distance | None, console: Console) -> None:
        with self.server.open() as session:
            heard, why = self._wave(session, rig, wand, distance, console)
        say(console, f"the wave ended: {why}")
        if heard.bad:
            say(console, f"warning: {heard.bad} messages were none and were skipped")
        kept = self._keep(heard.messages, console)
        try:
            placed = self._place(rig, wand, heard.messages, distance, console)
        except BaseException:
            if kept is not None:
                say(console, f"the wave is kept; to try it again: {self._again(kept)}")
            raise
        self.server.hand_over(placed, self.out, console)

    def _keep(self, messages: Sequence[Detections], console: Console) -> Path | None:
        """Write the wave before it is solved, so that nothing that goes wrong there can lose it."""
        path = wave_beside(self.out)
        try:
            before = save_wave(path, self.server.arena, messages)
        except ConfigError as error:
            say(console, f"warning: the wave is not kept: {error}")
            return None
        say(console, f"the wave is kept as {path}" + (f"; the one before as {before.name}" if before else ""))
        return path

    def _again(self, recording: Path) -> str:
        """The command that solves a kept wave with the options of this one."""
        options = {"recording": recording, "wand": self.wand, "rig": self.rig, "out": self.out}
        options |= {"only": self.only, "height": self.height, "maps": self.maps}
        words = [
            word for name, value in options.items() if value is not None for word in (f"--{name}", value)
        ]
        if self.distance is not None:
            words += ["--distance", *self.distance, "--distance-sigma", self.distance_sigma]
        return shlex.join(["python", "-m", "calib", "wand", *map(str, words)])

    def _wave(
        self, session: Session, rig: Rig, wand: Body, distance: Distance | None, console: Console
    ) -> tuple[CollectedFrames, str]:
        # Where the time is given and nobody looks, trial solutions would only take time from the cameras.
        trials = self.seconds is None or console.is_terminal
        with Live(console=progress_console(), transient=True) as live:
            return wave(
                session,
                self.server.arena,
                rig,
                wand,
                self.seconds or MOST_S,
                lambda told: live.update(show_progress(told)),
                by_itself=trials and self.seconds is None,
                trials=trials,
                distance=distance,
            )


def _of_lenses(rig: Rig) -> dict:
    """What the lenses' own calibration said stays true."""
    return {key: value for key, value in rig.calibration.items() if key == "lenses"}
