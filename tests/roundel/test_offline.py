# SPDX-License-Identifier: BSD-3-Clause
"""Calibration and tracking of the package `roundel`: exact without noise, and precise on rendered images."""

import json
import logging
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.rig.recording import RecordingWriter
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.messages import Keys, encode
from fusion.export.pose_formats import write_csv
from roundel import (
    Recording,
    Rig,
    Robots,
    RoundelError,
    calibrate_intrinsics,
    calibrate_wand,
    simulate,
    track,
)
from tests.calib.boards import LENS, SPEC, board_poses, render
from tests.calib.synthetic import WAND, camera_errors, record, ring
from tests.conftest import ROOT
from tests.fusion.synthetic import SINGLE, TRIANGLE, Arena, line
from tests.truth import true_camera
from tests.web.roundel.programs import roundel

DEMO = ROOT / "configs" / "demo"
DATA = ROOT / "tests" / "data" / "wand"


def save(path: Path, messages: list) -> Path:
    """A recording in which each message arrives when its frame is captured."""
    with RecordingWriter(path) as writer:
        for message in sorted(messages, key=lambda message: message.t_ns):
            writer.put(Keys("x").detections(message.camera), encode(message), message.t_ns)
    return path


def test_a_wand_without_noise_places_cameras_exactly(tmp_path: Path):
    """As exactly as tests/calib/wand/test_calibrate.py states: the model of an ellipse's centre is approximate."""
    arena = ring(3)
    recording = save(tmp_path / "rig.wave.mcap", record(arena, 8.0))
    result = calibrate_wand(arena.intrinsics, WAND, recording)
    off_m, off_rad = camera_errors(result.rig, arena.truth)
    assert off_m.max() < 1e-4
    assert off_rad.max() < 1e-4
    assert str(result).startswith(f"grade {result.grade}: ")
    assert result.grade <= "B"
    assert result.report.unplaced == {}


def test_the_rendered_wand(tmp_path: Path):
    """As the command: the rig has poses and the figures of its report, and its file can be read again."""
    result = calibrate_wand(DATA / "rig.yaml", DEMO / "wand.yaml", DATA / "observations.csv")
    off_m, _ = camera_errors(result.rig, Rig.load(DATA / "truth.yaml"))
    assert off_m.max() < 5e-3  # the file has centres of ellipses: tests/calib/wand/test_rendered_recording.py
    assert result.rig.calibration["grade"] == result.grade
    assert result.rig.calibration["command"] == "roundel.calibrate_wand"
    result.rig.save(tmp_path / "rig.yaml")
    assert Rig.load(tmp_path / "rig.yaml").cameras == result.rig.cameras


@pytest.mark.ci
def test_lenses_that_were_never_calibrated(tmp_path: Path):
    """Without a rig, each lens is found from a nominal one, as its image size is in the messages."""
    recording = save(tmp_path / "wave.mcap", record(ring(3), 8.0))
    assert len(calibrate_wand(None, WAND, recording).rig.placed()) == 3


def test_a_wand_that_fits_nothing(tmp_path: Path):
    messages = record(ring(3), 2.0)
    recording = save(tmp_path / "one.mcap", [m for m in messages if m.camera == "cam0"])
    with pytest.raises(RoundelError, match="two or more"):
        calibrate_wand(ring(3).intrinsics, WAND, recording)


@pytest.mark.ci
def test_a_lens_from_images_and_from_files(tmp_path: Path):
    """Both ways give the same lens, near the one of the renderer; a camera without a board is named."""
    images = [render(*pose) for pose in board_poses(0.6)]
    (tmp_path / "north").mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(tmp_path / "north" / f"{k:02}.png"), image)
    by_files = calibrate_intrinsics(tmp_path, SPEC)
    assert by_files.faults == {}
    blank = [np.zeros_like(images[0])] * 3
    by_images = calibrate_intrinsics({"north": images, "south": blank}, SPEC)
    assert by_images.rig["north"] == by_files.rig["north"]
    assert "the board is in no image" in by_images.faults["south"]
    camera = by_files.rig["north"]
    assert abs(camera.fx - LENS.fx) < 0.005 * LENS.fx
    assert by_files.lenses["north"].rms_px < 0.3
    placed = Rig.load(DATA / "truth.yaml")
    merged = calibrate_intrinsics({"north": images}, SPEC, rig=placed).rig
    assert merged["north"].T_world_cam is None
    assert merged["east"] == placed["east"]
    with pytest.raises(RoundelError, match="the board is in no image"):
        calibrate_intrinsics({"south": blank}, SPEC)


@pytest.fixture
def arena() -> Arena:
    """Robots that stand still or move evenly, as the filter assumes, seen without noise."""
    motions = {"a": line((0.2, 0.1, 0.2), (0.5, 0, 0)), "c": line((-0.5, 0, 0.2))}
    return Arena({"a": TRIANGLE, "c": SINGLE}, motions)


@pytest.mark.parametrize("smooth", [False, True])
def test_tracking_without_noise_is_exact(arena: Arena, tmp_path: Path, smooth: bool):
    """Once the velocity is known, the error of a position is that of float32 axes and of the detector's floor."""
    path = save(tmp_path / "arena.mcap", arena.messages(30))
    poses = list(track(path, Rig(cameras=arena.cameras), arena.robots, smooth=smooth))
    late = [pose for pose in poses if pose.robot == "a" and pose.state == "tracked"][15:]
    assert len(late) > 8
    for pose in late:
        assert np.abs(np.array(pose.position) - arena.truth("a", pose.t_ns)[1]).max() < 1e-4


def test_rendered_images_become_poses(tmp_path: Path):
    """From the simulator's images to poses of all robots: below 1 mm RMS at the true rig."""
    recording = simulate(DEMO / "scene.yaml", tmp_path, 1.5, start_s=15.0)
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert recording.cameras == tuple(sorted(truth["cameras"]))
    assert recording.rig is not None
    assert recording.rig.placed() == {}
    rig = Rig(cameras={name: true_camera(entry) for name, entry in truth["cameras"].items()})
    robots = Robots.load(DEMO / "robots.yaml")
    poses = list(track(recording, rig, robots))
    assert {pose.robot for pose in poses if pose.state == "tracked"} == set(robots)
    for robot in ("rover", "drone"):
        times, matrices = zip(*truth["robots"]["poses_at_stamps_of_cam0"][robot], strict=True)
        places = np.array(matrices)[:, :3, 3]
        mine = [pose for pose in poses if pose.robot == robot and pose.state == "tracked"]
        mine = [pose for pose in mine if times[0] <= pose.t_ns * 1e-9 <= times[-1]]
        at = np.array([pose.t_ns * 1e-9 for pose in mine])
        true = np.column_stack([np.interp(at, times, places[:, k]) for k in range(3)])
        error = np.array([pose.position for pose in mine]) - true
        assert len(mine) > 15
        assert np.sqrt((error**2).sum(axis=1).mean()) < 1e-3


@pytest.mark.ci
def test_the_poses_of_a_recorded_server_are_repeated(tmp_path: Path):
    """As `roundel replay` repeats them, byte for byte. Within a standard deviation of what the server published: the
    sample's server was an earlier version, which took noise for motion (0.8 mm in a frame set without a camera)."""
    path = ROOT / "configs" / "sample" / "recording.mcap"
    roundel("replay", str(path), "--out", "replayed.csv", folder=tmp_path)
    poses = list(track(path))
    write_csv(poses, tmp_path / "tracked.csv")
    assert (tmp_path / "tracked.csv").read_text() == (tmp_path / "replayed.csv").read_text()
    published = {(pose.robot, pose.t_ns): pose for pose in Recording(path).poses()}
    again = {(pose.robot, pose.t_ns): pose for pose in poses}
    both = published.keys() & again.keys()
    assert len(both) > 0.95 * len(published)
    off = np.array([np.subtract(published[key].position, again[key].position) for key in both])
    claimed = np.array([published[key].covariance_matrix[3:6, 3:6] for key in both])
    assert np.einsum("ni,ni->n", off, np.linalg.solve(claimed, off[:, :, None])[:, :, 0]).max() < 1.0
    assert np.mean(np.linalg.norm(off, axis=1) < 5e-4) > 0.99


def test_what_is_missing_is_named(tmp_path: Path, arena: Arena, caplog: pytest.LogCaptureFixture):
    path = save(tmp_path / "arena.mcap", arena.messages(5))
    with pytest.raises(ConfigError, match=r"arena\.mcap holds no rig"):
        track(path, robots=arena.robots)
    with pytest.raises(ConfigError, match=r"arena\.mcap holds no robots"):
        track(path, Rig(cameras=arena.cameras))
    with pytest.raises(RoundelError, match=r"no camera in .* has a pose"):
        track(path, DATA / "rig.yaml", arena.robots)
    some = dict(list(arena.cameras.items())[:3])
    with caplog.at_level(logging.WARNING, "roundel"):
        list(track(path, Rig(cameras=some), arena.robots))
    assert "which has no pose in the rig" in caplog.text
