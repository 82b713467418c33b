# SPDX-License-Identifier: BSD-3-Clause
"""`roundel verify`: scale and precision of a calibration, by an object of known size that was not used for it."""

import json as json_format
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from calib.commands.inputs import require_one
from calib.commands.output import save_image
from calib.rig.camera import Camera
from calib.rig.precision_map import draw_errors
from calib.rig.rig import load_rig
from calib.rig.wand_file import WandBody, load_wand
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.service import stopped_by_signals
from camera_node.foundation.terminal import say, track
from camera_node.protocol.requests import REQUEST_S
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions
from fusion.client.arena import Arena
from fusion.diagnosis.verification import LENGTH_SIGMA_M, Verification, Verifier
from fusion.model.limits import Limits
from fusion.protocol.pose_messages import Markers
from fusion.recordings.arena_recording import read_recording
from fusion.recordings.offline_fusion import (
    OfflineArena,
    Summary,
    cameras_of,
    fuse_again,
    fuse_recording,
    read_detections,
)
from fusion.recordings.recording_files import say_skipped

HOLDS, DIFFERS = 0, 1  # exit codes; 2 for mistakes, and where the object was not seen
MAX_SECONDS = 600.0
WAIT_S = 0.2  # between two looks at what has arrived


@dataclass(frozen=True, kw_only=True)
class Verify:
    """Verify a calibration by an object of known size that was not used for it, carried through the arena: a rod with
    two roundels, a board, another wand. The report states the scale, the precision by place, and whether the claimed
    covariances hold. The exit code is 0 if all of it holds, 1 if not, and 2 if the object was not seen."""

    known_object: Annotated[Path, tyro.conf.arg(name="object")]
    """The object, as in wand.yaml: diameter_m and markers, metres."""
    live: bool = False
    """Take the markers of the running server."""
    recording: Path | None = None
    """Or of a recording (MCAP) of roundel record."""
    frames: Path | None = None
    """Or detect in <FOLDER>/<camera>/<t_ns>.png|jpg."""
    rig: Path | None = None
    """The calibration to verify; by default that of the recording or of the server."""
    seconds: float = 60.0
    """With --live: how long the object is carried."""
    length_sigma_mm: float = 1e3 * LENGTH_SIGMA_M
    """Standard deviation of the object's lengths, millimetres."""
    map: Path | None = None
    """Draw the error of lengths by place in this PNG file."""
    json: bool = False
    """Print one JSON object."""
    connection: ConnectionOptions = LOCAL_SERVER

    def run(self) -> int:
        """Print the report."""
        require_one({"--live": self.live, "--recording MCAP": self.recording, "--frames FOLDER": self.frames})
        if not 0 < self.seconds <= MAX_SECONDS:
            raise ConfigError(
                f"--seconds is {self.seconds:g}; it must be above 0, and {MAX_SECONDS:g} at most"
            )
        if not 0 <= self.length_sigma_mm < 100:
            raise ConfigError(
                f"--length-sigma-mm is {self.length_sigma_mm:g}; it must be 0 or more, and below 100"
            )
        body = load_wand(self.known_object)
        cameras, verification = self._verify_live(body) if self.live else self._verify_recorded(body)
        if self.map is not None:
            grid, errors_mm = verification.floor_map()
            title = f"error of lengths, mm, RMS: {verification.rms_mm:.2f} in all places"
            save_image(self.map, draw_errors(grid, errors_mm, title, cameras))
        if self.json:
            say(json_format.dumps(verification.as_dict()))
        else:
            for line in verification.lines(str(self.known_object)):
                say(line)
        return HOLDS if verification.holds else DIFFERS

    def _verify_recorded(self, body: WandBody) -> tuple[dict[str, Camera], Verification]:
        summary = Summary()
        cameras, markers = self._read_recording(summary) if self.recording else self._detect(summary)
        verifier = Verifier(body, cameras, 1e-3 * self.length_sigma_mm)
        for message in track(markers, "fusing"):
            verifier.add(message)
        if not self.json:
            say_skipped(summary.faults)
        return cameras, verifier.report()

    def _read_recording(self, summary: Summary) -> tuple[dict[str, Camera], Iterator[Markers]]:
        assert self.recording is not None
        recorded = read_recording(self.recording)
        cameras = cameras_of(recorded, self.recording, self.rig)
        arena = OfflineArena(cameras, recorded.robots, limits=recorded.limits or Limits())
        fused = fuse_again(recorded, arena, summary, forms_sets=self.rig is not None)
        summary.faults.update(recorded.faults)
        return cameras, (result.markers for result in fused)

    def _detect(self, summary: Summary) -> tuple[dict[str, Camera], Iterator[Markers]]:
        if self.rig is None:
            raise ConfigError("--frames needs the calibration: --rig rig.yaml")
        cameras = load_rig(self.rig).require_placed(self.rig)
        messages = read_detections(self.frames, None, cameras)
        return cameras, (
            result.markers for result in fuse_recording(messages, OfflineArena(cameras, {}), summary)
        )

    def _verify_live(self, body: WandBody) -> tuple[dict[str, Camera], Verification]:
        with Arena(self.connection.wait(), self.connection.arena) as client:
            cameras = self._placed_cameras(client)
            verifier = Verifier(body, cameras, 1e-3 * self.length_sigma_mm)
            messages: deque[Markers] = deque()
            with stopped_by_signals() as stop:
                remove = client.markers().on_message(messages.append)
                if not self.json:
                    say(
                        f"carry {self.known_object} through the arena, {self.seconds:g} s; Ctrl-C ends it earlier"
                    )
                end_s = time.monotonic() + self.seconds
                while not stop.wait(WAIT_S) and time.monotonic() < end_s:
                    _take(verifier, messages)
                remove()
            if self._placed_cameras(client) != cameras:
                raise ConfigError("the server's rig changed during the verification; start again")
        _take(verifier, messages)
        return cameras, verifier.report()

    def _placed_cameras(self, client: Arena) -> dict[str, Camera]:
        rig = client.rig(REQUEST_S)
        if rig is None or not rig.placed():
            raise ConfigError("the server has no calibration; run roundel calibrate wand --live")
        if self.rig is not None and load_rig(self.rig).placed() != rig.placed():
            raise ConfigError(
                f"the server uses another rig than {self.rig}; leave --rig out, or run roundel calibrate apply"
            )
        return rig.placed()


def _take(verifier: Verifier, messages: deque[Markers]) -> None:
    """Give the messages that have arrived to the verifier, which keeps less of them."""
    while messages:
        verifier.add(messages.popleft())
