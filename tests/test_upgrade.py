# SPDX-License-Identifier: BSD-3-Clause
"""Folders and recordings of every released version are read by this one: nothing that a lab saved is lost."""

import shutil
from pathlib import Path

import pytest

from calib.rig.rig import Rig
from camera_node.protocol.camera_requests import request_cameras
from fusion.server.arena_config import load_arena
from roundel import track
from tests.conftest import ROOT
from tests.fusion.serving import serving

FOLDERS = sorted((ROOT / "tests" / "data").glob("arena_*"))


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_server_goes_on_with_the_folder_of_an_earlier_version(folder: Path, tmp_path: Path):
    """With the second calibration, which is in force, the first and third by undo and redo, robots and cameras."""
    copy = shutil.copytree(folder, tmp_path / "lab")
    with serving(load_arena(copy / "arena.yaml")) as (_, client):
        assert set(client.declared_robots().robots) == {"rover", "b"}
        rig = client.rig()
        assert rig is not None
        cameras = request_cameras(client.session, "test")
        assert cameras["door"].settings.exposure_us == 4000.0
        assert offsets(rig) == {"cam0": 1.0, "cam1": 1.0, "cam2": 1.0}
        assert offsets(client.undo_rig().rig) == dict.fromkeys(("cam0", "cam1", "cam2", "cam3"), 0.0)
        client.redo_rig()
        assert offsets(client.redo_rig().rig) == {"cam0": 2.0, "cam1": 2.0, "cam2": 2.0}


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_recording_of_an_earlier_version_is_tracked(folder: Path):
    poses = list(track(folder / "recording.mcap"))
    assert {pose.robot for pose in poses} == {"a"}
    assert poses[-1].state == "tracked"


def offsets(rig: Rig) -> dict[str, float]:
    """Clock offsets of the placed cameras, which differ between the calibrations, ms."""
    return {name: camera.time_offset_ms for name, camera in rig.placed().items()}
