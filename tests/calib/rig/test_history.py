# SPDX-License-Identifier: BSD-3-Clause
"""A rig is backed up before it is replaced, and undo restores it."""

from pathlib import Path

import pytest

from calib.errors import CalibrationError
from calib.rig.history import back_up, list_backups, undo
from calib.rig.rig import Rig, load_rig, save_rig
from camera_node.errors import ConfigError
from tests.calib.synthetic import ring


def numbered(k: int) -> Rig:
    """A rig that differs from others in its date."""
    return Rig(cameras=ring(2).truth.cameras, calibration={"date": k})


def test_saving_backs_up_and_undo_restores_step_by_step(tmp_path: Path):
    path = tmp_path / "rig.yaml"
    backups = [save_rig(numbered(k), path) for k in range(12)]
    assert backups[0] is None
    assert [p.name for p in list_backups(path)] == [f"rig.{k}.yaml" for k in range(1, 12)]  # 10 after 9
    for k in reversed(range(11)):
        undo(path)
        assert load_rig(path).calibration["date"] == k
        assert load_rig(tmp_path / "rig.undone.yaml").calibration["date"] == k + 1
    with pytest.raises(CalibrationError, match="no earlier rig"):
        undo(path)
    assert load_rig(path).calibration["date"] == 0


def test_undo_restores_a_deleted_rig(tmp_path: Path):
    path = tmp_path / "rig.yaml"
    for k in range(2):
        save_rig(numbered(k), path)
    path.unlink()
    undo(path)
    assert load_rig(path).calibration["date"] == 0


def test_other_files_in_the_folder_are_ignored(tmp_path: Path):
    for name in ("rig.old.yaml", "rig.yaml.1", "myrig.3.yaml", "rig.2.yml"):
        (tmp_path / name).write_text("mine")
    path = tmp_path / "rig.yaml"
    path.write_text("first")
    assert back_up(path) == tmp_path / "rig.1.yaml"
    assert back_up(tmp_path / "none.yaml") is None


def test_undo_in_a_missing_folder_is_a_config_error(tmp_path: Path):
    with pytest.raises(ConfigError, match="folder"):
        undo(tmp_path / "nowhere" / "rig.yaml")
