# SPDX-License-Identifier: BSD-3-Clause
"""Simulated cameras in real time, and rendered recordings with their truth."""

import csv
import json
import subprocess
import sys
import threading
import time
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import yaml

from camera_node.geometry.pose import Pose
from camera_node.simulation.renderer import Renderer
from camera_node.simulation.scene import Scene
from camera_node.simulation.simulated_camera import SimulatedCamera, render_recording
from camera_node.sources.recorded_frames import FrameFolder, read_grey
from tests.camera_node.scenes import CAMERA, DISC, write_scene
from tests.conftest import ROOT

FAST = CAMERA | {"fps": 100.0, "phase_ms": 3.0, "exposure_us": 4000.0}


@pytest.fixture
def scene_path(tmp_path) -> Path:
    motions = {"disc": {"x_m": {"amplitude": 0.3, "period_s": 3.0}}, "mate": {"y_m": {"mean": 0.4}}}
    robots = {"disc": DISC, "mate": DISC | {"markers": [[0, 0, 0], [0.25, 0, 0]]}}
    return write_scene(tmp_path, robots, motions, {"cam0": FAST, "cam1": CAMERA | {"fps": 30.0}})


def test_frames_have_the_cameras_exposure_times(scene_path):
    """Every stamp is the middle of an exposure to the nanosecond; no frame arrives before its exposure has ended."""
    epoch_ns = time.time_ns()
    camera = SimulatedCamera(scene_path, "cam0", epoch_ns)
    stamps = []
    for frame in islice(camera, 30):
        assert time.time_ns() >= frame.t_ns + 2_000_000
        assert (frame.image.shape, frame.image.dtype, frame.exposure_us) == ((240, 320), np.uint8, 4000.0)
        stamps.append(frame.t_ns)
    camera.close()
    indices = (np.array(stamps) - epoch_ns - 3_000_000) / 1e7
    assert (np.abs(indices - indices.round()) < 1e-6).all()
    steps = np.diff(indices.round())
    assert (steps >= 1).all()
    assert camera.dropped == (steps - 1).sum()


def test_a_frame_of_a_rolling_shutter_arrives_when_its_last_row_is_read(tmp_path):
    """It states the readout time, and its stamp is that of the middle row."""
    camera = CAMERA | {"fps": 40.0, "readout_us": -20000.0, "exposure_us": 4000.0}
    path = write_scene(tmp_path, {"disc": DISC}, {"disc": {}}, {"cam0": camera})
    source = SimulatedCamera(path, "cam0", time.time_ns())
    for frame in islice(source, 2):
        assert time.time_ns() >= frame.t_ns + 12_000_000
        assert frame.readout_us == -20000.0
    source.close()


def test_a_slow_reader_gets_the_newest_frame_and_the_others_are_counted(scene_path):
    """After five frame periods of other work, the next frame is at most one period old, plus its rendering."""
    epoch_ns = time.time_ns()
    camera = SimulatedCamera(scene_path, "cam0", epoch_ns)
    frames = iter(camera)
    first = next(frames)
    other = Renderer(Scene.load(scene_path), "cam1")
    while time.time_ns() < first.t_ns + 50_000_000:
        other.render(0.0)
    asked_ns = time.time_ns()
    second = next(frames)
    assert asked_ns - second.t_ns <= 12_000_000 + 1  # a period of 10 ms, and half the exposure
    assert camera.dropped == round((second.t_ns - first.t_ns) / 1e7) - 1 >= 3
    camera.close()


def test_frames_equal_those_of_a_renderer(scene_path):
    epoch_ns = time.time_ns() - 3_600_000_000_000
    frame = next(iter(SimulatedCamera(scene_path, "cam0", epoch_ns)))
    t_s = (frame.t_ns - epoch_ns) * 1e-9
    index = round((t_s - 0.003) * 100)
    assert (frame.image == Renderer(Scene.load(scene_path), "cam0").render(0.003 + index / 100, index)).all()


def test_closing_ends_a_wait_at_once(scene_path):
    """The first exposure is in an hour; a second thread waits for it until the camera is closed."""
    camera = SimulatedCamera(scene_path, "cam0", time.time_ns() + 3_600_000_000_000)
    frames: list = []
    waiting = threading.Thread(target=lambda: frames.extend(camera), daemon=True)
    waiting.start()
    camera.close()
    waiting.join(timeout=10)
    assert not waiting.is_alive()
    assert frames == []


def test_exposures_lie_in_the_time_span(scene_path):
    camera = Scene.load(scene_path).camera("cam0")
    assert camera.exposures(0.0, 0.023) == range(2)
    assert camera.exposures(0.003, 0.0231) == range(3)
    assert camera.exposures(-1.0, 0.002) == range(0)


def test_a_recording_has_the_frames_of_its_cameras(scene_path, tmp_path):
    scene = Scene.load(scene_path)
    render_recording(scene, tmp_path / "out", 1.0, 1.1, epoch_ns=5_000_000_000)
    frames = list(FrameFolder(tmp_path / "out" / "cam1"))
    assert [frame.t_ns for frame in frames] == [6_000_000_000 + round(k * 1e9 / 30) for k in range(3)]
    assert (frames[1].image == Renderer(scene, "cam1").render(31 / 30, 31)).all()
    assert len(FrameFolder(tmp_path / "out" / "cam0")) == 10
    rig = yaml.safe_load((tmp_path / "out" / "rig.yaml").read_text())["cameras"]
    assert set(rig) == {"cam0", "cam1"}
    assert "T_world_cam" not in rig["cam0"]


def test_the_truth_has_no_error_in_the_arena_score(scene_path, tmp_path, shared_data):
    """The true rig and poses are written in the formats of calibration and fusion."""
    tool = shared_data("README.md").parents[1] / "tools" / "score_arena.py"
    scene = Scene.load(scene_path)
    render_recording(scene, tmp_path, 1.0, 1.1)
    truth = json.loads((tmp_path / "truth.json").read_text())
    poses = {name: Pose.from_matrix(scene.T_world_cam(name)) for name in scene.cameras}
    rig = {
        name: {"T_world_cam": {"position_m": [*p.position_m], "wxyz": [*p.wxyz]}} for name, p in poses.items()
    }
    (tmp_path / "placed.yaml").write_text(yaml.safe_dump({"cameras": rig}))
    with (tmp_path / "poses.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["t_ns", "robot", "x", "y", "z", "qw", "qx", "qy", "qz"])
        for robot, track in truth["robots"]["poses_at_stamps_of_cam0"].items():
            for t_s, T in track:
                pose = Pose.from_matrix(T)
                rows.writerow([round(t_s * 1e9), robot, *pose.position_m, *pose.wxyz])
    files = [tmp_path / name for name in ("truth.json", "placed.yaml", "poses.csv")]
    done = subprocess.run(
        [sys.executable, tool, *files], capture_output=True, text=True, timeout=60, check=True
    )
    assert "cameras placed 2 of 2" in done.stdout
    assert "disc: answered 10 of 10 answerable of 10 instants; position mm rms 0.00" in done.stdout
    assert "mate: answered 10 of 10 answerable of 10 instants; position mm rms 0.00" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["gone.yaml", "out"], "gone.yaml does not exist"),
        (["scene.yaml", "out", "--cameras", "cam9"], "no camera 'cam9'"),
        (["scene.yaml", "out", "--seconds", "0"], "--seconds 0"),
        (["scene.yaml", "scene.yaml"], "can't be created"),
    ],
)
def test_a_fault_is_one_line_and_exit_code_2(scene_path, arguments, says):
    command = [sys.executable, "-m", "camera_node.simulation", *arguments]
    done = subprocess.run(
        command, cwd=scene_path.parent, env=_environment(), capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    assert says in done.stderr
    assert done.stderr.count("\n") == 1


def test_the_command_writes_frames(scene_path):
    arguments = ["scene.yaml", "out", "--start", "2", "--seconds", "0.1", "--cameras", "cam1"]
    command = [sys.executable, "-m", "camera_node.simulation", *arguments]
    subprocess.run(
        command, cwd=scene_path.parent, env=_environment(), check=True, timeout=60, capture_output=True
    )
    files = sorted((scene_path.parent / "out" / "cam1").iterdir())
    assert [path.name for path in files] == [
        f"{2_000_000_000 + round(k * 1e9 / 30):015d}.png" for k in range(3)
    ]
    assert read_grey(files[0]).shape == (240, 320)


def _environment() -> dict[str, str]:
    return {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
