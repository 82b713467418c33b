# SPDX-License-Identifier: BSD-3-Clause
"""Scenes: motions, errors in their files, and the properties of the demo's scene that other tests rely on."""

from itertools import combinations

import numpy as np
import pytest
import yaml

from camera_node.foundation.arrays import Array
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.body import Body
from camera_node.geometry.lens import load_lens
from camera_node.geometry.pose import invert
from camera_node.simulation.discs import place_discs
from camera_node.simulation.scene import Scene, SceneCamera
from tests.camera_node.scenes import CAMERA, DISC, load_disc, write_scene
from tests.conftest import ROOT

DEMO = ROOT / "configs" / "demo" / "scene.yaml"


@pytest.fixture(scope="module")
def demo() -> Scene:
    return Scene.load(DEMO)


def view_minor_px(camera: SceneCamera, body: Body, T_world_body: Array) -> float:
    """Minor axis in pixels of the body's flattest black disc; 0 unless all cards are entirely in the image."""
    smallest = np.inf
    for disc in place_discs(body, invert(camera.T_world_cam) @ T_world_body):
        uv = camera.project(disc.outline())
        inside = (uv > 0).all() and (uv < (camera.width - 1, camera.height - 1)).all()
        if not (disc.faces_camera and inside):
            return 0.0
        # Points evenly around an ellipse of half-axis b have the variance b^2 / 2 along it.
        half = np.sqrt(2 * np.linalg.eigvalsh(np.cov(uv.T, bias=True))[0]) * np.cos(np.pi / len(uv))
        smallest = min(smallest, 2 * half * disc.radii[1] / disc.radii[0])
    return float(smallest)


def velocity_of(scene: Scene, robot: str, t_s: float) -> Array:
    """(3,) m/s in the world, by central differences over 1 ms."""
    before, after = (scene.robot_pose(robot, t_s + dt) for dt in (-5e-4, 5e-4))
    assert before is not None
    assert after is not None
    return (after[:3, 3] - before[:3, 3]) / 1e-3


def test_robots_are_large_in_three_cameras_at_all_times(demo):
    """12 px is enough for the detectors of all peers; with three cameras a robot stays visible when one is occluded."""
    for t_s in np.arange(demo.wave_s, demo.wave_s + 90, 0.25):
        for name, (body, T) in demo.bodies_at(t_s).items():
            minors = [view_minor_px(camera, body, T) for camera in demo.cameras.values()]
            assert sum(minor >= 12 for minor in minors) >= 3, (name, t_s, minors)


def test_robots_do_not_collide(demo):
    """The origins of any two robots are at least 0.35 m apart."""
    for t_s in np.arange(demo.wave_s, demo.wave_s + 90, 0.25):
        places = [T[:3, 3] for _, T in demo.bodies_at(t_s).values()]
        assert min(np.linalg.norm(a - b) for a, b in combinations(places, 2)) > 0.35


def test_robots_drive_at_a_walking_pace(demo):
    speeds = [
        np.linalg.norm(velocity_of(demo, name, t)) for name in demo.robots for t in np.arange(15.1, 45, 0.5)
    ]
    assert min(speeds) > 0.15
    assert max(speeds) < 0.6


def test_the_wand_recording_calibrates_every_camera(demo):
    """Two cameras see the wand at 8 px or more most of the time; every pair sees it together for a fifth of it."""
    seen = []
    for t_s in np.arange(0, demo.wave_s, 0.1):
        (body, T) = demo.bodies_at(t_s)["wand"]
        seen.append([view_minor_px(camera, body, T) >= 8 for camera in demo.cameras.values()])
    seen = np.array(seen)
    assert (seen.sum(1) >= 2).mean() > 0.9
    together = seen.T.astype(float) @ seen / len(seen)
    assert together.min() > 0.2, together


def test_robots_replace_the_wand(demo):
    before, after = demo.wave_s - 1e-6, demo.wave_s
    assert set(demo.bodies_at(before)) == {"wand"}
    assert set(demo.bodies_at(after)) == set(demo.robots)
    assert demo.wand_pose(after) is None
    assert all(demo.robot_pose(name, before) is None for name in demo.robots)


def test_a_robot_that_faces_its_travel_points_along_its_velocity(demo):
    for t_s in np.arange(20, 32, 0.7):
        velocity = velocity_of(demo, "rover", t_s)
        assert demo.robot_pose("rover", t_s)[:3, 0] @ velocity == pytest.approx(
            np.linalg.norm(velocity), rel=1e-4
        )


def test_rig_entries_are_a_rig_without_poses(demo, tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump({"cameras": demo.rig_entries()}))
    lens = load_lens(path, "east")
    assert lens.distortion == demo.camera("east").distortion
    assert set(demo.rig_entries()["east"]) == {*CAMERA, "distortion", "model"} - {
        "position_m",
        "look_at_m",
        "noise",
    }


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"colour": "red"}, "colour"),
        ({"wand": "gone.yaml"}, "gone.yaml does not exist"),
        ({"cameras": {}}, "no camera"),
        ({"cameras": {"cam0": CAMERA | {"fsp": 30}}}, "fsp"),
        ({"cameras": {"cam0": CAMERA | {"look_at_m": [0.0, -0.6, 0.0]}}}, "exactly above"),
        ({"cameras": {"cam0": CAMERA | {"exposure_us": 1e6}}}, "exposure_us"),
        ({"cameras": {"cam0": CAMERA | {"fx": -1.0}}}, "focal"),
        ({"robot_motions": {}}, "robot 'disc'"),
        ({"robot_motions": {"disc": {"x_m": {"period_s": 0}}}}, "period"),
        ({"wand_motion": {"x_m": {"speed": 1}}}, "speed"),
    ],
)
def test_an_error_names_the_file_and_the_fault(tmp_path, change, says):
    path = write_scene(tmp_path, {"disc": DISC}, {"disc": {}})
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | change))
    with pytest.raises(ConfigError, match=says) as fault:
        Scene.load(path)
    assert str(tmp_path) in str(fault.value)
    assert "\n" not in str(fault.value)


def test_robots_are_read_from_the_servers_file(tmp_path):
    """Fields for the server are accepted; a misspelt key is not."""
    robot = DISC | {"motion": "ground", "start_m": [0.0, 0.0, 0.0]}
    assert set(Scene.load(write_scene(tmp_path, {"disc": robot}, {"disc": {}})).robots) == {"disc"}
    with pytest.raises(ConfigError, match="moton"):
        Scene.load(write_scene(tmp_path, {"disc": DISC | {"moton": "ground"}}, {"disc": {}}))


def test_a_robot_can_not_be_called_wand(tmp_path):
    with pytest.raises(ConfigError, match="rename the robot"):
        Scene.load(write_scene(tmp_path, {"wand": DISC}, {"wand": {}}))


def test_unknown_names_are_refused(tmp_path):
    scene = load_disc(tmp_path)
    with pytest.raises(ConfigError, match="no camera 'cam7'; it has cam0"):
        scene.camera("cam7")
    with pytest.raises(ConfigError, match="no robot 'r2'; it has disc"):
        scene.robot_pose("r2", 0.0)
