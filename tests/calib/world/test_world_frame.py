# SPDX-License-Identifier: BSD-3-Clause
"""Surveyed cameras fix a world."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.rig.rig import Rig
from calib.world.landmarks import locate_places, still_roundels
from calib.world.world_frame import align, align_places, move, read_positions, require_above, rescale, stand
from camera_node.config import load_yaml
from camera_node.detection.roundels import Roundels
from camera_node.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.geometry.pose import rotation_from_vector
from camera_node.protocol.messages import Detections
from tests.calib.synthetic import Arena, errors, ring
from tests.conftest import ROOT


def test_align_undoes_any_motion():
    truth = ring(5).truth
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_vector([0.3, -1.2, 0.7]), [1.0, -2.0, 0.5]
    places = {name: camera.matrix()[:3, 3] for name, camera in truth.cameras.items()}
    aligned, misses = align(move(truth, T), places)
    assert max(misses.values()) < 1e-9
    for name, camera in aligned.cameras.items():
        assert camera.matrix() == pytest.approx(truth.cameras[name].matrix(), abs=1e-9)
    assert errors(aligned, truth)[0] < 1e-9


def test_too_few_or_collinear_surveys_are_refused():
    truth = ring(4).truth
    places = {name: camera.matrix()[:3, 3] for name, camera in truth.cameras.items()}
    with pytest.raises(CalibrationError, match="three or more"):
        align(truth, {name: places[name] for name in ("cam0", "cam1")})
    with pytest.raises(CalibrationError, match="on a line"):
        align(truth, {f"cam{k}": [float(k), 0.0, 1.0] for k in range(4)})


L_FRAME = {"0": [0.0, 0.0, 0.0], "1": [0.5, 0.0, 0.0], "2": [0.0, 0.3, 0.0]}


def lie_still(
    arena: Arena, places: dict[str, list[float]], numbered: bool = False, clutter: int = 3
) -> list[Detections]:
    """What the cameras of an arena see of roundels at places of the world, to 0.05 px, and of a few false ones."""
    rng, messages = np.random.default_rng(2), []
    for name, camera in arena.truth.cameras.items():
        uv = camera.project_world(list(places.values()))
        false = rng.uniform([20, 20], [780, 580], (clutter, 2))
        ids = np.array([int(n) if numbered else -1 for n in places] + [-1] * clutter, np.int32)
        for seq in range(10):
            noisy = np.vstack([uv, false]) + 0.05 * rng.standard_normal((len(ids), 2))
            moving = rng.uniform([20, 20], [780, 580], (1, 2))
            columns = Roundels.from_points(np.vstack([noisy, moving]), 0.05, np.append(ids, np.int32(-1)))
            header = {"camera": name, "seq": seq, "t_ns": seq * 10**8, "width": 800, "height": 600}
            messages.append(Detections.pack(columns, **header))
    return messages


def elsewhere(rig: Rig) -> Rig:
    """The rig in a world that is turned and shifted."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_vector([0.1, -0.2, 2.0]), [1.0, -2.0, 0.5]
    return move(rig, T)


@pytest.mark.parametrize("numbered", [False, True])
def test_an_l_shaped_frame_fixes_the_world(numbered: bool):
    """Means of 10 views to 0.05 px, 3 m away at 540 px: under 0.1 mm a point, so under 1 mm 3 m away from a frame of
    half a metre."""
    arena = ring(4)
    places = {name: np.array(at) for name, at in L_FRAME.items()}
    rig = elsewhere(arena.truth)
    found = locate_places(rig.cameras, still_roundels(lie_still(arena, L_FRAME, numbered)), places)
    assert set(found) == set(L_FRAME)
    moved, misses = align_places(rig, found, places, "roundel")
    assert max(misses.values()) < 5e-4
    for name, camera in moved.cameras.items():
        assert camera.matrix() == pytest.approx(arena.truth.cameras[name].matrix(), abs=2e-3)


def test_a_standing_wand_fixes_floor_and_upwards():
    """z and the foot are the wand's; the heading is the first camera's."""
    arena = ring(4)
    upright = {str(k): [0.4, 0.2, 0.05 + z] for k, z in enumerate((0.0, 0.2, 0.5))}
    wand = {str(k): np.array([x, 0.0, 0.0]) for k, x in enumerate((0.0, 0.2, 0.5))}
    rig = elsewhere(arena.truth)
    found = locate_places(rig.cameras, still_roundels(lie_still(arena, upright)), wand)
    moved = stand(rig, np.array(list(found.values())), foot_m=0.05)
    for name, camera in moved.cameras.items():
        truth = arena.truth.cameras[name].matrix()
        assert camera.matrix()[2] == pytest.approx(truth[2], abs=2e-3)
        here, there = camera.matrix()[:2, 3], truth[:2, 3] - [0.4, 0.2]
        assert np.linalg.norm(here) == pytest.approx(np.linalg.norm(there), abs=2e-3)
    assert next(iter(moved.cameras.values())).matrix()[1, 0] == pytest.approx(0, abs=1e-9)


def test_a_rig_up_to_scale_takes_the_survey_s():
    truth = ring(4).truth
    small = rescale(msgspec.structs.replace(truth, calibration={"metric": False}), 0.37)
    aligned, misses = align(small, {name: camera.matrix()[:3, 3] for name, camera in truth.cameras.items()})
    assert aligned.calibration["metric"]
    assert max(misses.values()) < 1e-9


def test_what_can_not_be_is_refused():
    arena = ring(4)
    sightings = still_roundels(lie_still(arena, L_FRAME))
    square = {
        str(k): np.array(at) for k, at in enumerate([[0, 0, 0], [0.4, 0, 0], [0.4, 0.4, 0], [0, 0.4, 0]])
    }
    with pytest.raises(CalibrationError, match=r"no 3 of the roundels that lie still .*cam0 6"):
        locate_places(arena.truth.cameras, sightings, square)
    seen = still_roundels(lie_still(arena, {k: v.tolist() for k, v in square.items()}))
    with pytest.raises(CalibrationError, match="two ways"):
        locate_places(arena.truth.cameras, seen, square)
    places = {name: camera.matrix()[:3, 3] for name, camera in arena.truth.cameras.items()}
    swapped = dict(zip(places, [places[n] for n in ("cam1", "cam0", "cam2", "cam3")], strict=True))
    with pytest.raises(CalibrationError, match="do not fit: they miss by"):
        align(arena.truth, swapped)


def test_places_as_yaml_and_by_name(tmp_path: Path):
    (tmp_path / "places.yaml").write_text("a: [0, 1, 2]\nb: [3.5, 4, 5]\n")
    assert read_positions(tmp_path / "places.yaml")["b"] == pytest.approx([3.5, 4, 5])
    (tmp_path / "places.csv").write_text("name,x,y,z\na,0,1,2\n")
    assert list(read_positions(tmp_path / "places.csv")) == ["a"]
    (tmp_path / "places.yaml").write_text("a: [0, 1]\n")
    with pytest.raises(ConfigError, match=r"places\.yaml: .*length 3"):
        read_positions(tmp_path / "places.yaml")


@pytest.mark.parametrize(
    ("text", "fault"), [("camera,x,y\n", "lacks the column z"), ("camera,x,y,z\na,1,2,up\n", "line 2")]
)
def test_a_broken_survey_names_the_fault(tmp_path: Path, text: str, fault: str):
    path = tmp_path / "survey.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=fault):
        read_positions(path)


def test_the_frame_that_is_shipped_fixes_a_world():
    """`configs/l.yaml`: an L whose legs differ, as far as a turn is concerned."""
    frame = load_yaml(ROOT / "configs" / "l.yaml", Body)
    places = {str(k): point for k, point in enumerate(frame.points)}
    arena = ring()
    seen = still_roundels(lie_still(arena, {name: list(at) for name, at in places.items()}))
    rig = elsewhere(arena.truth)
    moved, misses = align_places(rig, locate_places(rig.placed(), seen, places), places, "roundel")
    assert max(misses.values()) < 1e-3
    require_above(moved, places)
    for name, camera in moved.cameras.items():
        assert camera.matrix() == pytest.approx(arena.truth.cameras[name].matrix(), abs=2e-3)
