# SPDX-License-Identifier: BSD-3-Clause
"""A rig reaches the running server from a fresh process, or the command says why not and exits with 2."""

from pathlib import Path

import msgspec
import pytest

from calib.rig.rig import Rig, load_rig, save_rig
from fusion.client.arena import Arena as Client
from fusion.server.config import ArenaConfig
from tests.fusion.serving import ARENA, DEADLINE_S, config, run_program, serving_process

OTHER = Rig(
    cameras={
        name: msgspec.structs.replace(camera, time_offset_ms=1.5) for name, camera in ARENA.cameras.items()
    }
)


def saving(folder: Path) -> ArenaConfig:
    """A server with a rig, that saves changes of it."""
    return msgspec.structs.replace(config(folder), saved_rig=str(folder / "rig.saved.yaml"))


def rig_of(endpoint: str) -> Rig:
    """The rig that the server answers with."""
    with Client.connect(endpoint, arena="test") as client:
        rig = client.rig(DEADLINE_S)
    assert rig is not None
    return rig


def to_server(endpoint: str) -> tuple[str, ...]:
    return ("--live", "--connect", endpoint, "--arena", "test")


def survey(folder: Path) -> Path:
    """positions.csv with the cameras 3 m further along x."""
    rows = [
        f"{name},{camera.matrix()[0, 3] + 3.0},{camera.matrix()[1, 3]},{camera.matrix()[2, 3]}"
        for name, camera in ARENA.cameras.items()
    ]
    (folder / "positions.csv").write_text("\n".join(["camera,x,y,z", *rows, ""]))
    return folder / "positions.csv"


@pytest.mark.parametrize("command", ["undo", "world"])
def test_a_command_in_a_fresh_process_changes_the_rig_of_the_server(tmp_path: Path, command: str):
    settings, file = saving(tmp_path), tmp_path / "mine.yaml"
    save_rig(OTHER, file)
    save_rig(Rig(cameras=ARENA.cameras), file)
    words = {
        "undo": ("undo", "--rig", str(file)),
        "world": ("world", "--rig", str(file), "--out", str(file), "--positions", str(survey(tmp_path))),
    }[command]
    with serving_process(settings) as (endpoint, _):
        assert rig_of(endpoint).cameras == ARENA.cameras
        done = run_program("calib", *words, *to_server(endpoint))
        assert done.returncode == 0, done.stderr
        changed = load_rig(file)
        assert changed.cameras != ARENA.cameras
        assert rig_of(endpoint).cameras == changed.cameras
        assert f"in force on the server at {endpoint}, arena 'test'" in done.stdout
