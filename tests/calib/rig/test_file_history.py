# SPDX-License-Identifier: BSD-3-Clause
"""A rig is backed up before it is replaced; undo and redo step through the versions, and none is lost."""

import subprocess
import sys
from pathlib import Path

import pytest

from calib.errors import CalibrationError
from calib.rig.file_history import MAX_OLD, History, Step
from calib.rig.rig import Rig, load_rig, save_rig
from camera_node.foundation.errors import ConfigError
from tests.calib.synthetic import ring
from tests.conftest import ROOT


def numbered(k: int) -> Rig:
    """A rig that differs from others in its date."""
    return Rig(cameras=ring(1).truth.cameras, calibration={"date": k})


def number_of(path: Path) -> int:
    return load_rig(path).calibration["date"]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def all_numbers(folder: Path) -> set[int]:
    """The rigs of all files in a folder."""
    return {number_of(path) for path in folder.glob("rig*.yaml")}


def test_undo_and_redo_step_through_all_versions(tmp_path: Path):
    path = tmp_path / "rig.yaml"
    backups = [save_rig(numbered(k), path) for k in range(12)]
    assert backups[0] is None
    history = History(path)
    assert [p.name for p in history.older()] == [f"rig.{k}.yaml" for k in range(1, 12)]  # 10 after 9
    for k in reversed(range(11)):
        step = history.take("undo")
        assert step.replaced is not None
        assert (number_of(path), number_of(step.replaced)) == (k, k + 1)
        assert all_numbers(tmp_path) == set(range(12))
    with pytest.raises(CalibrationError, match=r"no earlier version of .*rig\.yaml; nothing was changed"):
        history.take("undo")
    for k in range(1, 12):
        history.take("redo")
        assert number_of(path) == k
    with pytest.raises(CalibrationError, match="no undone version"):
        history.take("redo")
    assert names(tmp_path) == sorted(["rig.yaml", *(f"rig.{k}.yaml" for k in range(1, 12))])


def test_undone_rigs_are_reached_by_undo_after_a_new_calibration(tmp_path: Path):
    path = tmp_path / "rig.yaml"
    for k in range(3):
        save_rig(numbered(k), path)
    history = History(path)
    history.take("undo")
    history.take("undo")
    save_rig(numbered(3), path)
    seen = [number_of(path)]
    for _ in range(3):
        history.take("undo")
        seen.append(number_of(path))
    assert seen == [3, 0, 1, 2]


def test_at_most_twenty_old_rigs_are_kept(tmp_path: Path):
    path = tmp_path / "rig.yaml"
    for k in range(2 * MAX_OLD):
        save_rig(numbered(k), path)
    assert all_numbers(tmp_path) == set(range(MAX_OLD - 1, 2 * MAX_OLD))
    History(path).take("undo")
    save_rig(numbered(99), path)
    assert len(names(tmp_path)) == MAX_OLD + 1


def test_undo_restores_a_deleted_rig(tmp_path: Path):
    path = tmp_path / "rig.yaml"
    for k in range(2):
        save_rig(numbered(k), path)
    path.unlink()
    assert History(path).take("undo").replaced is None
    assert number_of(path) == 0


def test_other_files_in_the_folder_are_ignored(tmp_path: Path):
    for name in ("rig.old.yaml", "rig.yaml.1", "myrig.3.yaml", "rig.2.yml", "rig.undone.yaml"):
        (tmp_path / name).write_text("mine")
    path = tmp_path / "rig.yaml"
    path.write_text("first")
    assert History(path).back_up() == tmp_path / "rig.1.yaml"
    assert History(tmp_path / "none.yaml").back_up() is None
    assert (tmp_path / "rig.undone.yaml").read_text() == "mine"


def test_undo_in_a_missing_folder_is_a_config_error(tmp_path: Path):
    with pytest.raises(ConfigError, match="folder"):
        History(tmp_path / "nowhere" / "rig.yaml").take("undo")


# Kills itself at the n-th operation on a file, in a fork of this process; prints the number of operations.
KILLED = """
import os, signal, sys
from pathlib import Path
from calib.rig.file_history import History
from calib.rig.rig import load_rig, save_rig
folder, step, n = Path(sys.argv[1]), sys.argv[2], 0
rig = load_rig(folder / "new.yaml")

def act():
    path = folder / str(n) / "rig.yaml"
    save_rig(rig, path) if step == "save" else History(path).take(step)

while (child := os.fork()):
    died = os.WIFSIGNALED(os.waitpid(child, 0)[1])
    n += 1
    if not died:
        print(n)
        sys.exit()
count = 0
def count_operation(event, arguments):
    global count
    if event.startswith("os.") or event == "open":
        count += 1
        if count == n + 1:
            os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(count_operation)
act()
os._exit(0)
"""


@pytest.mark.parametrize(
    "step", ["save", *(pytest.param(step, marks=pytest.mark.ci) for step in ("undo", "redo"))]
)
def test_a_process_that_is_killed_at_any_step_leaves_a_readable_rig_and_all_versions(
    tmp_path: Path, step: str
):
    """In copies of one history, killed at each operation on a file in turn; afterwards undo and redo work."""
    copies = 40  # more than there are operations
    for n in range(copies):
        path = tmp_path / str(n) / "rig.yaml"
        path.parent.mkdir()
        for k in range(4):
            save_rig(numbered(k), path)
        History(path).take("undo")
    save_rig(numbered(9), tmp_path / "new.yaml")
    words = [sys.executable, "-c", KILLED, str(tmp_path), step]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    n_killed = int(done.stdout) - 1
    assert 3 < n_killed < copies - 1
    before, after = {"save": (2, 9), "undo": (2, 1), "redo": (2, 3)}[step]
    for n in range(n_killed + 1):
        path = tmp_path / str(n) / "rig.yaml"
        assert number_of(path) in (before, after)
        assert all_numbers(path.parent) >= {0, 1, 2, 3}
        assert number_of(path) == after or n < n_killed, "the last one was not killed"
        undone, redone = steps(path, "undo"), steps(path, "redo")
        assert len({*undone}) == len(undone), "no copy that the killed process left is restored"
        assert {*undone, *redone} >= {0, 1, 2, 3}


def steps(path: Path, direction: Step) -> list[int]:
    """The rigs from the present one to the first or last."""
    seen = [number_of(path)]
    while True:
        try:
            History(path).take(direction)
        except CalibrationError:
            return seen
        seen.append(number_of(path))
