# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks: reading their surveyed positions, and finding them among stationary roundels."""

import re
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.world.landmarks import FRAME, locate_landmarks, name_markers, read_positions
from calib.world.still_roundels import find_still_roundels
from calib.world.world_frame import align_positions, align_standing_wand, check_above
from camera_node.foundation.config import load_yaml
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.geometry.pose import rotation_from_vector
from tests.calib.synthetic import ring
from tests.calib.world.landmarks import L_FRAME, detect_landmarks, in_another_world, see_discs
from tests.conftest import ROOT


def test_positions_are_read_from_yaml_and_csv(tmp_path: Path):
    (tmp_path / "points.yaml").write_text("a: [0, 1, 2]\nb: [3.5, 4, 5]\n")
    assert read_positions(tmp_path / "points.yaml")["b"] == pytest.approx([3.5, 4, 5])
    (tmp_path / "points.csv").write_text("name,x,y,z\na,0,1,2\n")
    assert list(read_positions(tmp_path / "points.csv")) == ["a"]
    (tmp_path / "points.yaml").write_text("a: [0, 1]\n")
    with pytest.raises(ConfigError, match=r"points\.yaml: "):
        read_positions(tmp_path / "points.yaml")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("camera,x,y\n", "column z"),
        ("camera,x,y,z\na,1,2,up\n", "line 2"),
        ("camera,x,y,z\na,1,2,3\na,1,2,3\n", "'a' twice"),
    ],
)
def test_a_broken_survey_is_refused(tmp_path: Path, text: str, fault: str):
    path = tmp_path / "survey.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=fault):
        read_positions(path)


@pytest.mark.parametrize("numbered", [False, True])
def test_an_l_shaped_frame_fixes_the_world(numbered: bool):
    """Means of 10 views to 0.05 px, 3 m away at 540 px: under 0.1 mm a point, so under 1 mm 3 m away from a frame of
    half a metre."""
    arena = ring(4)
    landmarks = {name: np.array(at) for name, at in L_FRAME.items()}
    rig = in_another_world(arena.truth)
    roundels = find_still_roundels(detect_landmarks(arena, L_FRAME, numbered))
    located = locate_landmarks(rig.cameras, roundels, landmarks)
    assert set(located) == set(L_FRAME)
    moved, distances = align_positions(rig, located, landmarks, "roundel")
    assert max(distances.values()) < 5e-4
    for name, camera in moved.cameras.items():
        assert camera.matrix() == pytest.approx(arena.truth.cameras[name].matrix(), abs=2e-3)


@pytest.mark.parametrize("code", [(), (3, 1, 2)])
def test_the_code_of_a_robot_is_no_number_of_a_marker(code: tuple[int, ...]):
    """A robot with code 1 stands beside an L-frame of which marker 1 is plain, or has another code."""
    arena = ring(4)
    body = Body(diameter_m=0.09, markers=((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.5, 0.0)), code=code)
    landmarks = name_markers(body)
    markers = body.points.tolist()
    places = dict(zip(map(str, code) if code else ("-1", "-2", "-3"), markers, strict=True))
    robot = {} if code else {"1": [0.6, 0.4, 0.1]}
    messages = []
    for message in detect_landmarks(arena, places | robot, numbered=True):
        ids = np.frombuffer(message.id, "<i4")
        probability = np.where(ids > 0, 1.0, np.nan).astype("<f4").tobytes()
        messages.append(msgspec.structs.replace(message, id_probability=probability))
    located = locate_landmarks(arena.truth.cameras, find_still_roundels(messages), landmarks)
    for name, at in landmarks.items():
        assert located[name] == pytest.approx(at, abs=5e-4)


@pytest.mark.parametrize("normal", [[0.0, 0.0, 1.0], [0.48, -0.36, 0.8]])
def test_landmarks_are_the_centres_of_discs(normal: list[float]):
    """Without noise within 0.02 mm, which messages of 32 bits leave; centres of ellipses are 0.3 mm or more off."""
    arena = ring(4)
    landmarks = {name: np.array(at) for name, at in L_FRAME.items()}
    roundels = find_still_roundels(see_discs(arena, L_FRAME, normal, 0.06))
    located = locate_landmarks(arena.truth.cameras, roundels, landmarks)
    off = np.array([located[name] - at for name, at in landmarks.items()])
    points = [replace(roundel, shape=np.full((2, 2), np.nan)) for roundel in roundels]
    by_points = locate_landmarks(arena.truth.cameras, points, landmarks)
    off_points = np.array([by_points[name] - at for name, at in landmarks.items()])
    assert np.linalg.norm(off_points, axis=1).max() > 3e-4
    assert np.linalg.norm(off, axis=1).max() < 2e-5


def test_a_standing_wand_fixes_the_floor_and_the_vertical():
    """z and the foot are the wand's; the heading is the first camera's."""
    arena = ring(4)
    upright = {str(k): [0.4, 0.2, 0.05 + z] for k, z in enumerate((0.0, 0.2, 0.5))}
    wand = {str(k): np.array([x, 0.0, 0.0]) for k, x in enumerate((0.0, 0.2, 0.5))}
    rig = in_another_world(arena.truth)
    located = locate_landmarks(rig.cameras, find_still_roundels(detect_landmarks(arena, upright)), wand)
    moved = align_standing_wand(rig, np.array(list(located.values())), foot_m=0.05)
    for name, camera in moved.cameras.items():
        truth = arena.truth.cameras[name].matrix()
        assert camera.matrix()[2] == pytest.approx(truth[2], abs=2e-3)
        here, there = camera.matrix()[:2, 3], truth[:2, 3] - [0.4, 0.2]
        assert np.linalg.norm(here) == pytest.approx(np.linalg.norm(there), abs=2e-3)
    assert next(iter(moved.cameras.values())).matrix()[1, 0] == pytest.approx(0, abs=1e-9)


def test_landmarks_that_match_nothing_or_in_two_ways_are_refused():
    arena = ring(4)
    square = {
        str(k): np.array(at) for k, at in enumerate([[0, 0, 0], [0.4, 0, 0], [0.4, 0.4, 0], [0, 0.4, 0]])
    }
    roundels = find_still_roundels(detect_landmarks(arena, L_FRAME))
    with pytest.raises(CalibrationError, match=r"no 3 of the .*cam0 6"):
        locate_landmarks(arena.truth.cameras, roundels, square)
    roundels = find_still_roundels(detect_landmarks(arena, {k: v.tolist() for k, v in square.items()}))
    with pytest.raises(CalibrationError, match="two ways"):
        locate_landmarks(arena.truth.cameras, roundels, square)


def test_an_l_frame_with_another_leg_is_answered_with_its_lengths():
    """A file with the lengths that the error lists fixes the world."""
    arena = ring(4)
    real = {"0": [0.0, 0.0, 0.0], "1": [0.3, 0.0, 0.0], "2": [0.0, 0.7, 0.0]}
    roundels = find_still_roundels(see_discs(arena, real, [0.0, 0.0, 1.0], 0.06))
    false = {"0": np.zeros(3), "1": np.array([0.3, 0.0, 0.0]), "2": np.array([0.0, 0.5, 0.0])}
    with pytest.raises(
        CalibrationError, match="distances of the roundels of the L-frame: these are"
    ) as error:
        locate_landmarks(arena.truth.cameras, roundels, false, FRAME)
    assert "surveyed" not in str(error.value)
    listed = re.findall(r"[0-9.]+(?=[, ])", str(error.value).partition("see roundels at ")[2])[:2]
    assert listed == ["0.30", "0.70"]
    stated = {
        "0": np.zeros(3),
        "1": np.array([float(listed[0]), 0, 0]),
        "2": np.array([0, float(listed[1]), 0]),
    }
    assert set(locate_landmarks(arena.truth.cameras, roundels, stated, FRAME)) == {"0", "1", "2"}
    alone = [roundel for roundel in roundels if roundel.camera == "cam0"]
    with pytest.raises(CalibrationError, match="two cameras together see only 0 roundels"):
        locate_landmarks(arena.truth.cameras, alone, false, FRAME)


def test_the_shipped_frame_fixes_a_world():
    """`configs/l.yaml`: the legs differ enough to be distinguished."""
    frame = load_yaml(ROOT / "configs" / "l.yaml", Body)
    landmarks = {str(k): point for k, point in enumerate(frame.points)}
    arena = ring()
    roundels = find_still_roundels(
        detect_landmarks(arena, {name: list(at) for name, at in landmarks.items()})
    )
    rig = in_another_world(arena.truth)
    located = locate_landmarks(rig.placed(), roundels, landmarks)
    moved, distances = align_positions(rig, located, landmarks, "roundel")
    assert max(distances.values()) < 1e-3
    check_above(moved, landmarks)
    for name, camera in moved.cameras.items():
        assert camera.matrix() == pytest.approx(arena.truth.cameras[name].matrix(), abs=2e-3)


@pytest.mark.parametrize("cameras", [3, pytest.param(4, marks=pytest.mark.ci)])
@pytest.mark.parametrize("legs", [(0.36, 0.5), (0.3, 0.6), (0.6, 0.5), (0.33, 0.5)])
def test_roundels_at_other_distances_than_the_file_are_refused(cameras: int, legs: tuple[float, float]):
    """Where rays of different roundels meet, points have the distances of the file: two cameras see them, the others
    see a roundel elsewhere. Laid as the file says, they are located."""
    arena = ring(cameras)
    file = {"0": np.zeros(3), "1": np.array([0.3, 0.0, 0.0]), "2": np.array([0.0, 0.5, 0.0])}
    for turn in np.linspace(0, 6, 4):
        R = rotation_from_vector([0, 0, turn])
        laid = {"0": [0, 0, 0], "1": [legs[0], 0, 0], "2": [0, legs[1], 0]}
        wrong = {name: (R @ at + [0.2, 0.1, 0]).tolist() for name, at in laid.items()}
        with pytest.raises(CalibrationError, match="have the distances of"):
            locate_landmarks(arena.truth.placed(), find_still_roundels(detect_landmarks(arena, wrong)), file)
        right = {name: (R @ at + [0.2, 0.1, 0]).tolist() for name, at in file.items()}
        located = locate_landmarks(
            arena.truth.placed(), find_still_roundels(detect_landmarks(arena, right)), file
        )
        assert max(np.linalg.norm(located[name] - right[name]) for name in file) < 1e-3
