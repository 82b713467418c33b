# SPDX-License-Identifier: BSD-3-Clause
"""`roundel calibrate world`: fixes the ground plane, the origin and the axes."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from calib.commands.inputs import read_recording, require_one, require_positive, require_several_cameras
from calib.commands.output import check_folder, conclude, provenance, write_rig
from calib.errors import CalibrationError
from calib.live.collect import collect_with_progress
from calib.rig.camera import span_dimension
from calib.rig.rig import Rig, load_rig
from calib.world.landmarks import FRAME, SURVEY, WAND, align_to_roundels, name_markers, read_positions
from calib.world.resection import place_by_points
from calib.world.still_roundels import find_still_roundels
from calib.world.world_frame import align_cameras, check_above
from camera_node.foundation.arrays import Array
from camera_node.foundation.config import load_yaml
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions

UPSIDE_DOWN = 0.3  # mean upward component of the images' downward axes, above which cameras are upside down
Landmarks = Mapping[str, Array]


@dataclass(frozen=True, kw_only=True)
class World:
    """Fix the world frame: by surveyed cameras, by roundels at surveyed points, by an L-shaped frame, or by the wand
    standing upright on the floor. z is up, metres. With --camera, place cameras by the points that they see."""

    rig: Path
    """A rig with poses; with --camera, the lenses suffice."""
    out: Path
    """The file for the moved rig; a previous file is saved as rig.1.yaml, ..."""
    positions: Path | None = None
    """CSV with camera,x,y,z: positions of three or more cameras, metres."""
    points: Path | None = None
    """CSV with name,x,y,z, or YAML of name: [x, y, z]: positions of three or more stationary roundels, metres."""
    camera: tuple[str, ...] = ()
    """Place these cameras, each by four or more of the --points that it sees; other cameras keep their poses."""
    sigma: float = 0.002
    """Standard deviation of a coordinate of --points, metres, for the covariance of --camera."""
    frame: Path | None = None
    """YAML with diameter_m and markers of an L-shaped frame with roundels: its axes become those of the world."""
    standing: Path | None = None
    """YAML of a straight wand that stands upright at the origin."""
    foot: float = 0.0
    """Height of the standing wand's lowest roundel above the floor, metres, to its centre."""
    frames: Path | None = None
    """Detect the roundels in <FOLDER>/<camera>/<t_ns>.png|jpg."""
    observations: Path | None = None
    """Or read centres from a CSV: t_ns,camera,u,v[,marker]; a marker may be the name of a point."""
    live: bool = False
    """Or collect from the running cameras; have the server use the result."""
    seconds: float = 3.0
    """How long to collect from running cameras."""
    connection: ConnectionOptions = LOCAL_SERVER

    def run(self) -> None:
        """Move the rig and write it; nothing is written unless the world is fixed."""
        check_folder(self.out)
        surveys = {"--positions CSV": self.positions, "--points FILE": self.points}
        require_one({**surveys, "--frame YAML": self.frame, "--standing YAML": self.standing})
        rig = load_rig(self.rig)
        if self.camera:
            moved, distances = self._place_cameras(rig)
        else:
            rig.require_placed(self.rig)
            moved, distances = self._move(rig)
        for name, distance in distances.items():
            say(f"{name}: {distance * 1e3:.1f} mm from its surveyed position")
        misses = {name: round(distance * 1e3, 2) for name, distance in distances.items()}
        figures = {**moved.calibration, "world": {**provenance(), "misses_mm": misses}}
        moved = msgspec.structs.replace(moved, calibration=figures)
        write_rig(moved, self.out)
        conclude(self.connection, moved, self.out, "roundel calibrate world", live=self.live)

    def _move(self, rig: Rig) -> tuple[Rig, dict[str, float]]:
        """The moved rig, and the distances of surveyed cameras or landmarks from their positions, metres."""
        if self.positions is not None:
            return _move_by_cameras(rig, self.positions)
        file = self.points or self.frame or self.standing
        assert file is not None
        body = None if self.points else load_yaml(file, Body)
        landmarks = read_positions(file, "name") if body is None else name_markers(body)
        _check_landmarks(landmarks, file, on_line=self.standing is not None)
        foot = self.foot if self.standing is not None else None
        of = FRAME if self.frame is not None else WAND if self.standing is not None else SURVEY
        change = align_to_roundels(rig, landmarks, self._read_roundels(rig, body), foot, of)
        if change.missing:
            say(
                f"warning: fewer than two cameras see the roundel at {', '.join(change.missing)}; it is not used"
            )
        return change.rig, change.distances

    def _place_cameras(self, rig: Rig) -> tuple[Rig, dict[str, float]]:
        """The rig with the named cameras placed, and the distances of the points from their rays, metres."""
        if self.points is None:
            raise ConfigError("--camera needs --points FILE, the positions of the roundels that it sees")
        if not 0 <= self.sigma < math.inf:
            raise ConfigError(f"--sigma is {self.sigma:g}; it must be 0 or more, in metres")
        if unknown := [name for name in self.camera if name not in rig.cameras]:
            raise ConfigError(
                f"{self.rig} has no camera '{unknown[0]}'; it has {', '.join(sorted(rig.cameras))}"
            )
        points = read_positions(self.points, "name")
        roundels = find_still_roundels(self._read_roundels(rig, None))
        cameras, distances = dict(rig.cameras), {}
        for name in self.camera:
            seen = [roundel for roundel in roundels if roundel.camera == name]
            found = place_by_points(name, rig.cameras[name], seen, points, self.sigma)
            sigma_mm = 1e3 * np.sqrt(np.trace(np.array(found.camera.covariance)[3:, 3:]))
            say(f"{name}: placed by {len(found.misses_m)} points, +- {sigma_mm:.1f} mm")
            cameras[name] = found.camera
            distances |= {f"{name}, point {point}": miss for point, miss in found.misses_m.items()}
        placed = msgspec.structs.replace(rig, cameras=cameras)
        check_above(placed, points)
        return placed, distances

    def _read_roundels(self, rig: Rig, body: Body | None) -> list[Detections]:
        files = {"--frames FOLDER": self.frames, "--observations CSV": self.observations}
        require_one({**files, "--live": self.live}, ", to detect the roundels")
        if not self.live:
            if not self.camera:
                require_several_cameras(self.frames)
            return read_recording(rig, self.frames, self.observations, body=body)
        require_positive(self.seconds)
        with self.connection.open() as session:
            return collect_with_progress(session, self.connection.arena, self.seconds, "collecting").messages


def _move_by_cameras(rig: Rig, file: Path) -> tuple[Rig, dict[str, float]]:
    moved, distances = align_cameras(rig, read_positions(file))
    if np.mean([camera.matrix()[2, 1] for camera in moved.placed().values()]) > UPSIDE_DOWN:
        say("warning: most cameras are upside down in this world; check whether x and y are swapped")
    return moved, distances


def _check_landmarks(landmarks: Landmarks, file: Path, on_line: bool) -> None:
    """Raise CalibrationError for landmarks that can't fix a world, before any work is done."""
    points = np.array(list(landmarks.values())).reshape(-1, 3)
    if on_line and (len(points) < 2 or span_dimension(points) != 1):
        raise CalibrationError(f"{file} is not a straight wand with two or more roundels; give it as --frame")
    if not on_line and len(points) < 3:
        raise CalibrationError(f"{file} has {len(points)} points; a world needs three or more")
    if not on_line and span_dimension(points) < 2:
        raise CalibrationError(
            f"the points in {file} lie on a line, which leaves the rotation about it open; move a roundel away from "
            "that line, or stand a straight wand upright and give it as --standing"
        )
