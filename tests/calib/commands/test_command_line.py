# SPDX-License-Identifier: BSD-3-Clause
"""`python -m calib` end to end: files in, a rig out; errors are one line and exit code 2."""

import functools
import json
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.rig.rig import Rig, load_rig, save_rig
from camera_node.sources.recorded_detections import write_observations
from tests.calib.boards import SPEC, board_poses, render
from tests.calib.synthetic import Arena, assert_near, record, ring
from tests.calib.world.landmarks import L_FRAME, detect_landmarks, in_another_world
from tests.processes import run_program
from tests.truth import true_camera
from tests.waiting import DEADLINE_S

WAND_YAML = "diameter_m: 0.12\nmarkers: [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.5, 0.0, 0.0]]\n"


calib = functools.partial(run_program, "calib")


@pytest.fixture
def arena(tmp_path: Path) -> Arena:
    """An arena; its intrinsics, wand and observations are in `tmp_path`."""
    ring_arena = ring()
    save_rig(ring_arena.intrinsics, tmp_path / "lenses.yaml")
    (tmp_path / "wand.yaml").write_text(WAND_YAML)
    write_observations(tmp_path / "observations.csv", record(ring_arena, 6.0, sigma_px=0.1, numbered=True))
    return ring_arena


def wand_options(folder: Path) -> list[object]:
    return ["--wand", folder / "wand.yaml", "--rig", folder / "lenses.yaml", "--out", folder / "rig.yaml"]


def test_wand_then_world_from_a_csv(tmp_path: Path, arena: Arena):
    done = calib("wand", *wand_options(tmp_path), "--observations", tmp_path / "observations.csv")
    assert done.returncode == 0, done.stderr
    assert "residual" in done.stdout
    rig = load_rig(tmp_path / "rig.yaml")
    assert_near(rig, arena.truth, 3e-3, 1.5e-3)  # as without the file: noise is 0.1 px
    assert rig.calibration["cameras"]["cam0"]["observations"] > 50
    rows = [f"{n},{','.join(map(str, c.matrix()[:3, 3]))}" for n, c in arena.truth.cameras.items()]
    (tmp_path / "survey.csv").write_text("\n".join(["camera,x,y,z", *rows]))
    surveyed = ("--positions", tmp_path / "survey.csv", "--out", tmp_path / "world.yaml")
    done = calib("world", "--rig", tmp_path / "rig.yaml", *surveyed)
    assert done.returncode == 0, done.stderr
    for name, camera in load_rig(tmp_path / "world.yaml").cameras.items():
        truth = arena.truth.cameras[name].matrix()
        assert camera.matrix()[:3, 3] == pytest.approx(truth[:3, 3], abs=5e-3)


@pytest.mark.ci
def test_observations_of_unknown_lenses_need_the_image_size_only(tmp_path: Path, arena: Arena):
    """Without a rig file: a guess of 90 degrees for lenses of 75; focal lengths come within 1 %."""
    options = [
        *wand_options(tmp_path),
        "--observations",
        tmp_path / "observations.csv",
        "--field-of-view",
        90,
    ]
    options[options.index(tmp_path / "lenses.yaml")] = tmp_path / "none.yaml"
    asked = calib("wand", *options)
    assert asked.returncode == 2
    assert "--image-size WIDTH HEIGHT" in asked.stderr
    done = calib("wand", *options, "--image-size", 800, 600)
    assert done.returncode == 0, done.stderr
    assert "starting from a field of view of 90 degrees" in done.stdout
    for name, camera in load_rig(tmp_path / "rig.yaml").cameras.items():
        assert camera.fx == pytest.approx(arena.truth.cameras[name].fx, rel=0.01)


@pytest.mark.parametrize(
    ("file", "text", "fault"),
    [
        ("wand.yaml", "diameter_m: 0.1\nmarkers: [[0,0,0],[0.2,0,0],[0.4,0,0]]\n", "symmetric"),
        ("wand.yaml", "diameter_m: 0.1\nmarker: [[0,0,0]]\n", "did you mean `markers`"),
        ("lenses.yaml", "cameras: {cam0: {time_offset_ms: 1.0}}\n", "no intrinsics"),
        ("lenses.yaml", "cameras: [", "not valid YAML"),
        ("lenses.yaml", "cameras: {cam0: {}, cam0: {}}\n", "'cam0' is defined twice"),
        ("lenses.yaml", "version: 9\ncameras: {}\n", "of this version of Roundel?"),
        ("observations.csv", "t_ns,camera,u,v\n0,cam0,1,1\n", "one camera"),
        ("observations.csv", "t_ns,camera,u,v\n0,cam0,1,1\n0,cam9,1,1\n", "'cam9'"),
        ("observations.csv", "t_ns,camera,u,v\n0,cam0,1,1\n0,cam1,1,1\n", "in no frame"),
    ],
)
def test_an_error_is_one_line_and_nothing_is_overwritten(
    tmp_path: Path, arena: Arena, file: str, text: str, fault: str
):
    rows = (tmp_path / "observations.csv").read_text().splitlines()
    unnumbered = [row.rsplit(",", 2)[0] for row in rows]
    (tmp_path / "observations.csv").write_text("\n".join(unnumbered) + "\n")
    (tmp_path / "rig.yaml").write_text("precious")
    (tmp_path / file).write_text(text)
    done = calib("wand", *wand_options(tmp_path), "--observations", tmp_path / "observations.csv")
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert len(done.stderr.splitlines()) == 1
    assert fault in done.stderr
    assert (tmp_path / "rig.yaml").read_text() == "precious"


@pytest.mark.ci
def test_a_full_disk_changes_no_file(tmp_path: Path, arena: Arena):
    """A limit of 1000 bytes per file acts like a full disk."""
    (tmp_path / "rig.yaml").write_text("precious")
    before = sorted(tmp_path.iterdir())
    options = [*wand_options(tmp_path), "--observations", tmp_path / "observations.csv"]
    done = subprocess.run(
        [sys.executable, "-m", "calib", "wand", *map(str, options)],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000)),
    )
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "rig.yaml can't be written" in done.stderr
    assert (tmp_path / "rig.yaml").read_text() == "precious"
    assert sorted(tmp_path.iterdir()) == before


def test_check_judges_a_rig_and_writes_only_to_the_given_files(tmp_path: Path, arena: Arena):
    """By the recording that it was calibrated from: poses and halves agree, and the copy of the rig has the figures."""
    write_observations(
        tmp_path / "observations.csv", record(arena, 10.0, sigma_px=0.1, numbered=True, free_running=False)
    )
    observations = ("--observations", tmp_path / "observations.csv")
    assert calib("wand", *wand_options(tmp_path), *observations).returncode == 0
    before = (tmp_path / "rig.yaml").read_text()
    outputs = ("--out", tmp_path / "checked.yaml", "--maps", tmp_path / "maps")
    done = calib(
        "check", "--rig", tmp_path / "rig.yaml", "--wand", tmp_path / "wand.yaml", *observations, *outputs
    )
    assert done.returncode == 0, done.stderr
    for words in ("the two halves of the recording agree", "the rig and the recording agree", "grade "):
        assert words in done.stdout
    assert (tmp_path / "rig.yaml").read_text() == before
    check = load_rig(tmp_path / "checked.yaml").calibration["check"]
    assert check["halves"]["agree"]
    assert check["expected_mm"]["median"] < 2
    names = {f"{name}.png" for name in (*arena.truth.cameras, "expected")}
    assert {path.name for path in (tmp_path / "maps").iterdir()} == names
    assert all(cv2.imread(str(tmp_path / "maps" / name)) is not None for name in names)


@pytest.mark.ci
def test_only_calibrates_one_camera_and_leaves_the_others(tmp_path: Path, arena: Arena):
    """From the same recording; the other cameras are unchanged, and an unknown camera is named."""
    write_observations(
        tmp_path / "observations.csv", record(arena, 12.0, sigma_px=0.1, numbered=True, sized=False)
    )
    options = ("--wand", tmp_path / "wand.yaml", "--observations", tmp_path / "observations.csv")
    assert calib("wand", *wand_options(tmp_path), *options[2:]).returncode == 0
    rig = tmp_path / "rig.yaml"
    done = calib("wand", *options, "--rig", rig, "--out", tmp_path / "one.yaml", "--only", "cam1")
    assert done.returncode == 0, done.stderr
    assert "cam1: moved" in done.stdout
    before, after = load_rig(rig), load_rig(tmp_path / "one.yaml")
    assert after.cameras["cam0"] == before.cameras["cam0"]
    assert after.calibration["only"]["camera"] == "cam1"
    wrong = calib("wand", *options, "--rig", rig, "--out", tmp_path / "one.yaml", "--only", "cam77")
    assert wrong.returncode == 2
    assert "cam77" in wrong.stderr


def test_an_l_shaped_frame_fixes_the_world(tmp_path: Path):
    """The true world results from observations of an L and its YAML; mirrored and collinear points are refused."""
    arena = ring()
    save_rig(in_another_world(arena.truth), tmp_path / "rig.yaml")
    write_observations(tmp_path / "floor.csv", detect_landmarks(arena, L_FRAME))
    (tmp_path / "l.yaml").write_text(f"diameter_m: 0.1\nmarkers: {list(L_FRAME.values())}\n")
    options = ["--rig", tmp_path / "rig.yaml", "--observations", tmp_path / "floor.csv", "--out"]
    done = calib("world", "--frame", tmp_path / "l.yaml", *options, tmp_path / "world.yaml")
    assert done.returncode == 0, done.stderr
    for name, camera in load_rig(tmp_path / "world.yaml").cameras.items():
        assert camera.matrix() == pytest.approx(arena.truth.cameras[name].matrix(), abs=2e-3)
    mirrored = {name: [y, x, z] for name, (x, y, z) in L_FRAME.items()}
    (tmp_path / "m.yaml").write_text(f"diameter_m: 0.1\nmarkers: {list(mirrored.values())}\n")
    done = calib("world", "--frame", tmp_path / "m.yaml", *options, tmp_path / "none.yaml")
    assert (done.returncode, "mirrored" in done.stderr) == (2, True)
    (tmp_path / "line.csv").write_text("name,x,y,z\na,0,0,0\nb,1,0,0\nc,2,0,0\n")
    done = calib("world", "--points", tmp_path / "line.csv", *options, tmp_path / "none.yaml")
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "line.csv lie on a line" in done.stderr
    assert not (tmp_path / "none.yaml").exists()


def test_one_camera_is_placed_by_points_on_the_floor(tmp_path: Path):
    """From lenses without poses; the other cameras stay without."""
    arena = ring()
    save_rig(arena.intrinsics, tmp_path / "lenses.yaml")
    points = {**L_FRAME, "3": [-0.6, -0.4, 0.0], "4": [0.4, -0.7, 0.0]}
    only = [m for m in detect_landmarks(arena, points, clutter=0) if m.camera == "cam1"]
    write_observations(tmp_path / "floor.csv", only)
    (tmp_path / "points.yaml").write_text("".join(f"'{name}': {at}\n" for name, at in points.items()))
    options = [
        "--rig",
        tmp_path / "lenses.yaml",
        "--observations",
        tmp_path / "floor.csv",
        "--camera",
        "cam1",
    ]
    done = calib("world", *options, "--points", tmp_path / "points.yaml", "--out", tmp_path / "rig.yaml")
    assert done.returncode == 0, done.stderr
    assert "cam1: placed by 5 points" in done.stdout
    placed = load_rig(tmp_path / "rig.yaml").placed()
    assert list(placed) == ["cam1"]
    assert placed["cam1"].matrix() == pytest.approx(arena.truth.cameras["cam1"].matrix(), abs=5e-3)
    done = calib("world", *options, "--out", tmp_path / "none.yaml")
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)


@pytest.mark.parametrize("word", ["undo", "--undo"])
def test_undo_restores_the_previous_rig(tmp_path: Path, arena: Arena, word: str):
    before = (tmp_path / "rig.yaml", tmp_path / "rig.1.yaml")
    for path in before:
        shutil.copy(tmp_path / "lenses.yaml", path)
    (tmp_path / "rig.yaml").write_text("a mistake")
    done = calib(word, "--rig", tmp_path / "rig.yaml")
    assert (done.returncode, "rig.1.yaml" in done.stdout) == (0, True), done.stderr
    assert load_rig(tmp_path / "rig.yaml") == load_rig(tmp_path / "lenses.yaml")
    assert (tmp_path / "rig.undone.1.yaml").read_text() == "a mistake"
    done = calib(word, "--rig", tmp_path / "rig.yaml")
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)


def test_a_folder_of_one_camera_or_of_an_unknown_one_is_refused(tmp_path: Path, arena: Arena):
    frames = tmp_path / "frames"
    (frames / "cam0").mkdir(parents=True)
    done = calib("wand", *wand_options(tmp_path), "--frames", frames)
    assert (done.returncode, "one camera, 'cam0'" in done.stderr) == (2, True)
    (frames / "north").mkdir()
    done = calib("wand", *wand_options(tmp_path), "--frames", frames)
    assert (done.returncode, "'north'" in done.stderr) == (2, True)


@pytest.mark.ci
def test_frames_of_an_arena_from_another_renderer(tmp_path: Path, shared_data: Callable[[str], Path]):
    """Four free-running cameras: the error of every camera is below 3 mm and 0.1 degrees."""
    recording = shared_data("arena_small")
    truths = json.loads((recording / "truth.json").read_text())["cameras"]
    lenses = {name: true_camera(entry, placed=False) for name, entry in truths.items()}
    truth = {name: true_camera(entry) for name, entry in truths.items()}
    save_rig(Rig(cameras=lenses), tmp_path / "lenses.yaml")
    (tmp_path / "wand.yaml").write_text(WAND_YAML)
    done = calib("wand", *wand_options(tmp_path), "--frames", recording / "wand")
    assert done.returncode == 0, done.stderr
    found = load_rig(tmp_path / "rig.yaml")
    assert set(found.placed()) == set(truths)
    assert_near(found, Rig(cameras=truth), 3e-3, np.radians(0.1))


def test_intrinsics_refuse_invalid_boards_and_images(tmp_path: Path):
    out = ("--out", tmp_path / "rig.yaml")
    done = calib("intrinsics", "--frames", tmp_path, "--board", "charuco:5by4", *out)
    assert (done.returncode, "is not a board" in done.stderr) == (2, True)
    (tmp_path / "cam0").mkdir()
    cv2.imwrite(str(tmp_path / "cam0" / "1.png"), np.zeros((40, 60), np.uint8))
    done = calib("intrinsics", "--frames", tmp_path, "--board", "charuco:5x4:0.05", *out)
    assert (done.returncode, "the board is in no image" in done.stderr) == (2, True)
    (tmp_path / "cam0" / "2.png").write_text("no image")
    done = calib("intrinsics", "--frames", tmp_path, "--board", "charuco:5x4:0.05", *out)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert not (tmp_path / "rig.yaml").exists()


@pytest.mark.ci
def test_one_bad_camera_does_not_discard_the_other_lenses(tmp_path: Path):
    """Exit code 2 with the reason for the bad one; the lens of the good one is written."""
    for k, pose in enumerate(board_poses(0.6)):
        for name in ("good", "bad"):
            (tmp_path / "frames" / name).mkdir(parents=True, exist_ok=True)
            image = render(*pose) if name == "good" else np.zeros((480, 640), np.uint8)
            cv2.imwrite(str(tmp_path / "frames" / name / f"{k}.png"), image)
    out = tmp_path / "rig.yaml"
    done = calib("intrinsics", "--frames", tmp_path / "frames", "--board", SPEC, "--out", out)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "camera 'bad': the board is in no image" in done.stderr
    assert "written without it: good" in done.stderr
    assert list(load_rig(out).cameras) == ["good"]
