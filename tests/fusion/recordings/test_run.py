# SPDX-License-Identifier: BSD-3-Clause
"""`fusion run` writes poses.csv; invalid input gives one line and exit code 2."""

import csv
import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calib.rig.rig import Rig, save_rig
from camera_node.sources.recorded_detections import write_observations
from fusion.commands.run import run
from fusion.export.pose_formats import COLUMNS
from fusion.model.robots import Robot, save_robots
from tests.fusion.synthetic import SINGLE, TRIANGLE, Arena, line
from tests.processes import run_program
from tests.truth import true_camera

ARENA = Arena(
    {"a": TRIANGLE, "c": SINGLE},
    {"a": line((0.2, 0.1, 0.2), (0.5, 0, 0)), "c": line((-0.5, 0, 0.2))},
    sigma_px=0.05,
)


@pytest.fixture
def recording(tmp_path) -> dict[str, Path]:
    files = {name: tmp_path / name for name in ("rig", "robots", "observations", "out")}
    save_rig(Rig(cameras=ARENA.cameras), files["rig"])
    save_robots(ARENA.robots, files["robots"])
    write_observations(files["observations"], ARENA.messages(20))
    return files


def test_observations_become_poses(recording, capsys):
    assert run(**recording) == 0
    with recording["out"].open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == COLUMNS.split(",")
    last = [row for row in rows if row["robot"] == "a" and row["state"] == "tracked"][-1]
    truth = ARENA.truth("a", int(last["t_ns"]))[1]
    assert np.abs(np.array([last[k] for k in "xyz"], float) - truth).max() < 3e-3
    assert "a: tracked" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("no rig", "does not exist"),
        ("unplaced", "no camera in"),
        ("broken", "not valid YAML"),
        ("no input", "either --frames"),
    ],
)
def test_invalid_input_is_reported_in_one_line(recording, fault, said):
    if fault == "no rig":
        recording["rig"].unlink()
    elif fault == "unplaced":
        camera = msgspec.structs.replace(ARENA.cameras["cam0"], T_world_cam=None)
        save_rig(Rig(cameras={"cam0": camera}), recording["rig"])
    elif fault == "broken":
        recording["robots"].write_text("robots: [{")
    else:
        del recording["observations"]
    options = [part for name, path in recording.items() for part in (f"--{name}", str(path))]
    done = run_program("fusion", "run", *options)
    assert done.returncode == 2
    error = done.stderr
    assert said in error
    assert len(error.strip().splitlines()) == 1


@pytest.mark.ci
def test_a_recording_of_another_renderer(shared_data, tmp_path):
    """Three robots and four free-running cameras with their true poses: at most 3 mm RMS, the goal for an arena.

    Measured: 0.3 mm; 2.3 mm for robot_b, which two cameras see under 75 to 80 degrees when it leaves. In its last two
    frame sets a single camera sees one marker of it: these poses, which claim 21 and 48 mm, do not count.
    """
    folder = shared_data("arena_small")
    truth = json.loads((folder / "truth.json").read_text())
    cameras = {name: true_camera(entry) for name, entry in truth["cameras"].items()}
    save_rig(Rig(cameras=cameras), tmp_path / "rig.yaml")
    size = truth["robots"]["outer_diameter_m"]
    markers = truth["robots"]["markers_m"]
    robots = {name: Robot(diameter_m=size, markers=tuple(map(tuple, m))) for name, m in markers.items()}
    save_robots(robots, tmp_path / "robots.yaml")
    run(
        rig=tmp_path / "rig.yaml",
        robots=tmp_path / "robots.yaml",
        out=tmp_path / "poses.csv",
        frames=folder / "robots",
    )
    with (tmp_path / "poses.csv").open() as file:
        tracked = [row for row in csv.DictReader(file) if row["state"] == "tracked"]
    rows = [row for row in tracked if int(row["n_cameras"]) > 1]
    assert len(rows) >= 0.98 * len(tracked)
    for robot, poses in truth["robots"]["poses_at_stamps_of_cam0"].items():
        mine = np.array(
            [[row[k] for k in ("t_ns", "x", "y", "z")] for row in rows if row["robot"] == robot], float
        )
        times = np.array([t for t, _ in poses])
        places = np.array([np.array(T)[:3, 3] for _, T in poses])
        inside = (mine[:, 0] * 1e-9 >= times[0]) & (mine[:, 0] * 1e-9 <= times[-1])
        true = np.column_stack([np.interp(mine[inside, 0] * 1e-9, times, places[:, k]) for k in range(3)])
        rms = np.sqrt(((mine[inside, 1:] - true) ** 2).sum(1).mean())
        assert len(mine) > 20
        assert rms < 3e-3
