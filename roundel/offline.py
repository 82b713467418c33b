# SPDX-License-Identifier: BSD-3-Clause
"""Calibration, tracking and simulation for programs: each is one call, as the command of the same name."""

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from os import PathLike
from pathlib import Path
from typing import Any

import msgspec

from calib.errors import CalibrationError
from calib.intrinsics.board import make_finder
from calib.intrinsics.images import find_cameras, read_frames
from calib.intrinsics.lens_calibration import BoardViews, CalibratedLens, Model, merge_lenses
from calib.rig.camera import Camera
from calib.rig.rig import Rig
from calib.rig.wand_file import load_wand
from calib.wand.calibrate import calibrate
from calib.wand.nominal_lens import with_nominal_lenses
from calib.wand.quality.agreement import Agreement, CameraPoses, compare_calibrations
from calib.wand.quality.grade import RigQuality, assess
from calib.wand.scale import SIGMA_M, Distance
from calib.wand.wand_report import WandReport
from camera_node.foundation.arrays import Grey
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.simulation.scene import Scene
from camera_node.simulation.simulated_camera import render_recording
from fusion.model.limits import Limits
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import RobotPose, Robots
from fusion.recordings.arena_recording import FRAMES, ArenaRecording, read_recording
from fusion.recordings.offline_fusion import (
    OfflineArena,
    Summary,
    fuse_frame_sets,
    fuse_recording,
    recorded_frame_sets,
)
from roundel.recorded import Recording

log = logging.getLogger("roundel")
FilePath = str | PathLike[str]


@dataclass(frozen=True, slots=True)
class LensCalibration:
    """The result of `calibrate_intrinsics`.

    Attributes:
        rig: the calibrated cameras, and those of the rig that was given; `rig.save("rig.yaml")` writes it.
        lenses: what is known of each lens, by camera: `rms_px`, `coverage`, `sigma_px`, `warnings()` and so on.
        faults: why a lens could not be calibrated, by camera.
    """

    rig: Rig
    lenses: dict[str, CalibratedLens]
    faults: dict[str, str]


@dataclass(frozen=True, slots=True)
class WandResult:
    """The result of `calibrate_wand`.

    Attributes:
        rig: the cameras with poses, covariances and clock offsets; `rig.save("rig.yaml")` writes it.
        report: residuals, the length of the wand, and all that was left out, with the reasons.
        quality: the grade, A to D, and the expected error of points where the wand was.
        poses: of the placed cameras, with the joint covariance that `compare` needs.
    """

    rig: Rig
    report: WandReport
    quality: RigQuality
    poses: CameraPoses

    def compare(self, other: "WandResult | Rig") -> Agreement:
        """Test whether another calibration of the same cameras agrees, whatever the world frame of each is.

        Args:
            other: from another recording; or a rig, whose cameras have covariances.

        Returns:
            the test: `holds`, `shift_mm` and `turn_deg` by camera after the best rigid motion of the world, `moved`,
            and `sentence()`.

        Raises:
            CalibrationError: fewer than two cameras are in both.
        """
        return compare_calibrations(
            self.poses, other.poses if isinstance(other, WandResult) else CameraPoses.of_rig(other)
        )

    @property
    def grade(self) -> str:
        """A (good) to D."""
        return self.quality.grade

    def __str__(self) -> str:
        return self.quality.sentence()


def calibrate_intrinsics(
    frames: FilePath | Mapping[str, Iterable[Grey]],
    board: str,
    *,
    camera: str | None = None,
    model: Model = "pinhole",
    rig: Rig | FilePath | None = None,
) -> LensCalibration:
    """Calibrate lenses from views of a board (`roundel calibrate intrinsics`).

        result = calibrate_intrinsics("board", "charuco:5x7:0.035")
        result.rig.save("rig.yaml")

    Args:
        frames: a folder of `<camera>/*.png|jpg`, a folder of one camera's images, a video or a folder of videos; or the
            grey images (h, w) of each camera by its name.
        board: `charuco:COLSxROWS:SQUARE_M[:MARKER_RATIO[:DICTIONARY]]` in squares, or `chessboard:COLSxROWS:SQUARE_M`
            in inner corners.
        camera: the camera's name, or the only one to calibrate.
        model: OpenCV's pinhole model with 5 distortion coefficients, or its fisheye model with 4.
        rig: the other cameras of the result. A camera with a new lens loses its pose.

    Raises:
        CameraError: there are no frames.
        ConfigError: `board` names no board.
        CalibrationError: no lens can be calibrated; the message has the reason for each.
    """
    known = None if rig is None else _rig(rig)
    lenses: dict[str, CalibratedLens] = {}
    faults: dict[str, str] = {}
    for views in _board_views(frames, board, camera):
        try:
            lenses[views.camera] = views.calibrate(model)
        except CalibrationError as error:
            faults[views.camera] = str(error)
    if not lenses:
        raise CalibrationError("; ".join(faults.values()) or "there is no camera; give its images")
    origin = {**_provenance("calibrate_intrinsics"), "board": board}
    return LensCalibration(merge_lenses(known, lenses, origin), lenses, faults)


def calibrate_wand(
    rig: Rig | FilePath | None,
    wand: Body | FilePath,
    recording: Recording | FilePath,
    *,
    distance: tuple[str, str, float] | None = None,
    distance_sigma_m: float = SIGMA_M,
    synchronised: bool = False,
    height_m: float = 0.1,
) -> WandResult:
    """Estimate poses and clock offsets of cameras from the wand in front of them (`roundel calibrate wand`).

        result = calibrate_wand("rig.yaml", "wand.yaml", "rig.wave.mcap")
        print(result.grade, result.report.residual_px)
        result.rig.save("rig.yaml")

    Args:
        rig: the lenses of the cameras; poses are not used. In an MCAP recording, the lens of a camera that it lacks is
            found from a nominal one; without a rig, all of them.
        wand: the file of the wand, or its markers.
        recording: of the wand; a file or folder, see `Recording`.
        distance: two cameras and the metres between their lenses: the scale for a wand of one marker, else a check.
        distance_sigma_m: standard deviation of that distance, metres.
        synchronised: the cameras are triggered together. Without it, the recording decides.
        height_m: height of the robots' roundels, metres, for which errors are predicted.

    Raises:
        CalibrationError: the recording or the wand does not place two cameras, or most cameras contradict each other.
        ConfigError: a file is missing or broken.
    """
    lenses = Rig(cameras={}) if rig is None else _rig(rig)
    body = wand if isinstance(wand, Body) else load_wand(Path(wand))
    if not isinstance(recording, Recording):
        recording = Recording(recording, inner_ratios=(body.inner_ratio,))
    messages = [message for _, message in recording.arrivals(lenses)]
    if recording.is_mcap:
        sizes = {message.camera: (message.width, message.height) for message in messages}
        lenses, _ = with_nominal_lenses(lenses, sizes)
    measured = Distance.of(distance, distance_sigma_m, list(lenses.cameras))
    result = calibrate(lenses, body, messages, measured, synchronised)
    quality = assess(result, body, height_m)
    figures = {**_provenance("calibrate_wand"), **quality.as_dict(), **result.as_dict()}
    if "lenses" in lenses.calibration:
        figures["lenses"] = lenses.calibration["lenses"]
    return WandResult(
        msgspec.structs.replace(result.rig, calibration=figures),
        result.report,
        quality,
        CameraPoses.of_calibration(result),
    )


def track(
    recording: Recording | FilePath,
    rig: Rig | FilePath | None = None,
    robots: Robots | Mapping[str, Robot] | FilePath | None = None,
    *,
    smooth: bool = False,
    rate_hz: float | None = None,
) -> Iterator[RobotPose]:
    """Estimate the poses of all robots in a recording, by the code that runs live (`roundel run`, `roundel replay`).

        for pose in track("recording", "rig.yaml", "robots.yaml"):
            print(pose.t_ns, pose.robot, pose.position)

    Without `rig` and `rate_hz`, the poses of a recorded server are repeated exactly. Otherwise frame sets are formed
    from the times of arrival. What is skipped is logged as a warning at the end.

    Args:
        recording: a file or folder, see `Recording`.
        rig: the placed cameras; those of the recording unless given.
        robots: the declared robots; those of the recording unless given.
        smooth: estimate each pose from later frames, too, not only from those before it; a few seconds are held in
            memory.
        rate_hz: poses a second; without it the rate of the fastest camera.

    Returns:
        the poses of all robots that were acquired at least once, frame set by frame set.

    Raises:
        ConfigError: a file is missing or broken, or the recording has no rig or no robots and none are given.
        CalibrationError: no camera has a pose.
        FusionError: the robots can't be distinguished.
    """
    recording = recording if isinstance(recording, Recording) else Recording(recording)
    placed, declared = _cameras_of(recording, rig), _robots_of(recording, robots)
    arena = OfflineArena(placed, declared, rate_hz, recording.limits or Limits(), smooth)
    return _poses(recording, arena, recording.is_mcap and rig is None and rate_hz is None)


def simulate(
    scene: FilePath,
    folder: FilePath,
    seconds: float = 10.0,
    *,
    start_s: float = 0.0,
    cameras: Iterable[str] | None = None,
) -> Recording:
    """Render the cameras of a simulated arena into a folder (`roundel simulate`).

        recording = simulate("configs/demo/scene.yaml", "recording", seconds=15)

    Args:
        scene: the YAML file of a scene. Its wand moves first, its robots after it.
        folder: where to write `<camera>/<t_ns>.png`, `truth.json`, and `rig.yaml` with the intrinsics.
        seconds: duration of the recording.
        start_s: its beginning, seconds after the scene's.
        cameras: the cameras to render; all unless given.

    Raises:
        ConfigError: the scene is broken, or lacks one of the cameras, or the folder can't be written to.
        CameraError: a frame can't be written.
    """
    names = None if cameras is None else list(cameras)
    render_recording(Scene.load(Path(scene)), Path(folder), start_s, start_s + seconds, names)
    return Recording(folder)


def _board_views(
    frames: FilePath | Mapping[str, Iterable[Grey]], board: str, camera: str | None
) -> Iterator[BoardViews]:
    finder = make_finder(board)
    if isinstance(frames, Mapping):
        images = {name: _numbered(frames[name]) for name in frames if camera in (None, name)}
    else:
        images = {name: read_frames(path) for name, path in find_cameras(Path(frames), camera).items()}
    for name, named_images in images.items():
        views = BoardViews(name, finder)
        for image_name, image in named_images:
            views.add(image_name, image)
        yield views


def _numbered(images: Iterable[Grey]) -> Iterator[tuple[str, Grey]]:
    return ((f"image {number}", image) for number, image in enumerate(images))


def _poses(recording: Recording, arena: OfflineArena, is_as_live: bool) -> Iterator[RobotPose]:
    summary, before = Summary(), recording.faults.copy()
    held = read_recording(recording.path) if is_as_live else ArenaRecording()
    if held.counts[FRAMES]:
        results = fuse_frame_sets(recorded_frame_sets(held, arena.cameras, summary.faults), arena, summary)
    else:
        results = fuse_recording(recording.arrivals(Rig(cameras=arena.cameras)), arena, summary)
    for fused in results:
        yield from fused.poses
    for reason, count in sorted((recording.faults - before + summary.faults).items()):
        log.warning("%s: skipped %d %s", recording.path, count, reason)
    for move in summary.moves:
        log.warning("%s: %s", recording.path, move)


def _cameras_of(recording: Recording, rig: Rig | FilePath | None) -> dict[str, Camera]:
    used = recording.rig if rig is None else _rig(rig)
    if used is None:
        raise ConfigError(f"{recording.path} holds no rig; give the rig")
    return used.require_placed(recording.path if isinstance(rig, Rig | None) else Path(rig))


def _robots_of(
    recording: Recording, robots: Robots | Mapping[str, Robot] | FilePath | None
) -> dict[str, Robot]:
    used = recording.robots if robots is None else robots
    if used is None:
        raise ConfigError(f"{recording.path} holds no robots; give the robots")
    if isinstance(used, Mapping):
        return dict(used)
    return (used if isinstance(used, Robots) else Robots.load(used)).robots


def _rig(rig: Rig | FilePath) -> Rig:
    return rig if isinstance(rig, Rig) else Rig.load(rig)


def _provenance(function: str) -> dict[str, Any]:
    return {"date": datetime.now(UTC).isoformat(timespec="seconds"), "command": f"roundel.{function}"}
