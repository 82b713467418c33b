# SPDX-License-Identifier: BSD-3-Clause
"""`calib world`: ground plane, origin and axes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console

from calib.commands.choice import require_one
from calib.commands.connection import Connection, Server
from calib.commands.output import check_folder, provenance, say, write_rig
from calib.commands.recording import read_recording
from calib.errors import CalibrationError
from calib.live.collect import collect
from calib.rig.rig import Rig, load_rig
from calib.world.landmarks import is_line, locate_places, still_roundels
from calib.world.world_frame import align, align_places, read_positions, require_above, stand
from camera_node.arrays import Array
from camera_node.config import load_yaml
from camera_node.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections

UPSIDE_DOWN = 0.3  # of the images' downward axes, that points up, on average
Places = Mapping[str, Array]


@dataclass(frozen=True, kw_only=True)
class World:
    """Choose the world: by surveyed cameras, by roundels at known places, by an L-shaped frame, or by the wand
    standing upright on the floor. z is up, metres."""

    rig: Path
    """A rig with poses."""
    out: Path
    """Where the moved rig is written; a rig that is there is kept as rig.1.yaml, ..."""
    positions: Path | None = None
    """CSV with camera,x,y,z: where three or more cameras stand, metres."""
    points: Path | None = None
    """CSV with name,x,y,z, or YAML of name: [x, y, z]: where three or more roundels lie still, metres."""
    frame: Path | None = None
    """Roundels on an L-shaped frame, as YAML with diameter_m and markers: its own axes become the world's."""
    standing: Path | None = None
    """A straight wand's YAML, the wand standing upright where the origin shall be."""
    foot: float = 0.0
    """Metres from the floor to the centre of the standing wand's lowest roundel."""
    frames: Path | None = None
    """Where roundels lie: detect in <FOLDER>/<camera>/<t_ns>.png|jpg."""
    observations: Path | None = None
    """Or take centres from a CSV: t_ns,camera,u,v[,marker]; a marker may be a point's name."""
    live: bool = False
    """Or look through the running cameras, and hand them the result."""
    seconds: float = 3.0
    """How long to look through running cameras."""
    server: Server = field(default_factory=Connection)

    def execute(self, console: Console) -> None:
        """Nothing is written unless the world is fixed."""
        check_folder(self.out)
        places = {"--positions CSV": self.positions, "--points FILE": self.points}
        require_one({**places, "--frame YAML": self.frame, "--standing YAML": self.standing})
        rig = load_rig(self.rig)
        rig.require_placed(self.rig)
        moved, misses = self._move(rig, console)
        for name, miss in misses.items():
            say(console, f"{name}: {miss * 1e3:.1f} mm from its surveyed place")
        world = {**provenance(), "misses_mm": {name: round(miss * 1e3, 2) for name, miss in misses.items()}}
        moved = msgspec.structs.replace(moved, calibration={**moved.calibration, "world": world})
        write_rig(moved, self.out, console)
        if self.live:
            self.server.hand_over(moved, self.out, console)

    def _move(self, rig: Rig, console: Console) -> tuple[Rig, dict[str, float]]:
        if self.positions is not None:
            moved, misses = align(rig, read_positions(self.positions))
            if np.mean([camera.matrix()[2, 1] for camera in moved.placed().values()]) > UPSIDE_DOWN:
                say(console, "warning: most cameras hang upside down in this world; are x and y swapped?")
            return moved, misses
        file = self.points or self.frame or self.standing
        assert file is not None
        body = None if self.points else load_yaml(file, Body)
        places = read_positions(file, "name") if body is None else _markers(body)
        _check(places, file, on_line=self.standing is not None)
        found = locate_places(rig.placed(), still_roundels(self._look(rig, body)), places)
        if missing := [name for name in places if name not in found]:
            say(
                console,
                f"warning: two cameras did not see the roundel at {', '.join(missing)}; it is not used",
            )
        if self.standing is not None:
            return stand(rig, np.array(list(found.values())), self.foot), {}
        moved, misses = align_places(rig, found, places, "roundel")
        require_above(moved, places)
        return moved, misses

    def _look(self, rig: Rig, body: Body | None) -> list[Detections]:
        files = {"--frames FOLDER": self.frames, "--observations CSV": self.observations}
        require_one({**files, "--live": self.live}, ", to see the roundels")
        if not self.live:
            return read_recording(rig, self.frames, self.observations, body)
        if not self.seconds > 0:
            raise ConfigError(f"--seconds is {self.seconds}; it must be above 0")
        with self.server.open() as session:
            return collect(session, self.server.arena, self.seconds, "looking").messages


def _markers(body: Body) -> dict[str, Array]:
    return {str(k): point for k, point in enumerate(body.points)}


def _check(places: Places, file: Path, on_line: bool) -> None:
    """Refuse places that can't fix a world, before any work is done."""
    points: Any = np.array(list(places.values())).reshape(-1, 3)
    if on_line and (len(points) < 2 or not is_line(points)):
        raise CalibrationError(f"{file} is no straight wand of two or more roundels; give it as --frame")
    if not on_line and len(points) < 3:
        raise CalibrationError(f"{file} has {len(points)} places; three or more fix a world")
    if not on_line and is_line(points):
        raise CalibrationError(
            f"the places in {file} lie on a line: the turn about it stays open; lay a roundel away from that line, "
            "or stand a straight wand upright and give it as --standing"
        )
