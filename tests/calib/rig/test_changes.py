# SPDX-License-Identifier: BSD-3-Clause
"""What differs between two versions of a rig, and the line in which a saved rig says so."""

import os
from pathlib import Path

import msgspec
import pytest

from calib.rig.camera import Camera
from calib.rig.changes import RigChange, describe_change, holds_rig, read_change
from calib.rig.rig import Rig, load_rig, save_rig
from camera_node.geometry.pose import Pose
from camera_node.protocol.requests import RequestSource
from tests.calib.world.landmarks import in_another_world
from tests.web.arena import four_cameras

RIG = four_cameras()
CHANGE = RigChange(t_ns=10**18, change="north 12.0 mm", source=RequestSource("web", "lab", "x"))


def replaced(name: str, **fields: object) -> Rig:
    return Rig(cameras={**RIG.cameras, name: msgspec.structs.replace(RIG.cameras[name], **fields)})


def moved(camera: Camera, metres: float) -> Pose:
    T = camera.matrix()
    T[0, 3] += metres
    return Pose.from_matrix(T)


def test_changes_are_described():
    without_west = Rig(cameras={name: camera for name, camera in RIG.cameras.items() if name != "west"})
    renamed = Rig(cameras={"door" if name == "west" else name: c for name, c in RIG.cameras.items()})
    assert describe_change(None, RIG) == "4 cameras placed"
    assert describe_change(RIG, RIG) == "the same poses"
    assert describe_change(RIG, without_west) == "west not placed"
    assert describe_change(without_west, RIG) == "west placed"
    assert describe_change(RIG, renamed) == "west renamed door"
    assert describe_change(RIG, in_another_world(RIG)) == "floor and origin"
    assert describe_change(RIG, replaced("north", fx=600.0)) == "lens of north"
    assert describe_change(RIG, replaced("north", time_offset_ms=1.0)) == "clock offset of north"
    pose = moved(RIG.cameras["north"], 0.012)
    assert describe_change(RIG, replaced("north", T_world_cam=pose)) == "north 12.0 mm"


def test_many_changes_are_counted():
    cameras = {
        name: msgspec.structs.replace(camera, T_world_cam=moved(camera, 0.01 * (k + 1)), fx=600.0)
        for k, (name, camera) in enumerate(RIG.cameras.items())
    }
    assert describe_change(RIG, Rig(cameras=cameras)).endswith("20.0 mm, 1 more, lens of 4 cameras")


def test_a_saved_rig_says_what_changed(tmp_path: Path):
    """In a comment: programs that do not know it read the rig all the same."""
    path = tmp_path / "rig.yaml"
    save_rig(RIG, path, CHANGE.line())
    assert (read_change(path), load_rig(path)) == (CHANGE, RIG)
    assert holds_rig(path, RIG)
    assert not holds_rig(path, replaced("north", fx=600.0))


@pytest.mark.parametrize(
    "line", ["", "# changed: by hand\n", '# changed: {"t_ns": -1}\n', '# changed: {"t_ns": 1, "change": 2}\n']
)
def test_a_file_without_a_change_has_the_time_of_its_modification(tmp_path: Path, line: str):
    path = tmp_path / "rig.yaml"
    save_rig(RIG, path, line)
    os.utime(path, ns=(10**18, 10**18))
    assert read_change(path) == RigChange(t_ns=10**18)
