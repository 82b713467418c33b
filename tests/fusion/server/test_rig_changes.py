# SPDX-License-Identifier: BSD-3-Clause
"""A rig reaches the running server from a command, or the command says why not and exits with 2."""

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
import zenoh

from calib.rig.rig import Rig, load_rig, save_rig
from camera_node.foundation.config import dump_yaml
from camera_node.protocol.messages import Detections, encode
from camera_node.protocol.session import open_client
from fusion.client.arena import Arena as Client
from fusion.server.arena_config import ArenaConfig
from fusion.server.arena_queries import RIG_ANSWERS_HZ
from tests.calib.synthetic import assert_near, record, ring
from tests.conftest import ROOT, free_port
from tests.fusion.serving import ARENA, KEYS, config, serving, serving_process
from tests.processes import run_program
from tests.waiting import DEADLINE_S, in_thread

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


@contextmanager
def waving(endpoint: str, messages: list[Detections]) -> Iterator[None]:
    """Cameras that publish a wand recording as soon as a program records the wand."""
    recording = threading.Event()
    with open_client([endpoint]) as session:
        token = session.liveliness().declare_subscriber(
            KEYS.wand, lambda sample: recording.set(), history=True
        )

        def publish() -> None:
            if recording.wait(DEADLINE_S):
                for message in messages:
                    block = zenoh.CongestionControl.BLOCK  # nothing may be dropped at this rate
                    session.put(KEYS.detections(message.camera), encode(message), congestion_control=block)

        with in_thread(publish, recording.set):
            yield
        token.undeclare()


def require_in_force(endpoint: str, file: Path, done: subprocess.CompletedProcess[str]) -> None:
    """The command succeeded, and the server answers with the rig in its file."""
    assert done.returncode == 0, done.stderr
    changed = load_rig(file)
    assert changed.cameras != ARENA.cameras
    assert rig_of(endpoint).cameras == changed.cameras
    assert f"in force on the server at {endpoint}, arena 'test'" in done.stdout


@pytest.mark.parametrize(
    "command",
    [*(pytest.param(command, marks=pytest.mark.ci) for command in ("undo", "redo", "world")), "apply"],
)
def test_a_command_in_a_fresh_process_changes_the_rig_of_the_server(tmp_path: Path, command: str):
    settings, file = saving(tmp_path), tmp_path / "mine.yaml"
    first, second = (
        (OTHER, Rig(cameras=ARENA.cameras))
        if command in ("undo", "world")
        else (Rig(cameras=ARENA.cameras), OTHER)
    )
    save_rig(first, file)
    save_rig(second, file)
    if command == "redo":
        assert run_program("calib", "undo", "--rig", str(file)).returncode == 0
    words = [command, "--rig", str(file)]
    words += ["--out", str(file), "--positions", str(survey(tmp_path))] if command == "world" else []
    with serving_process(settings) as (endpoint, _):
        assert rig_of(endpoint).cameras == ARENA.cameras
        server = to_server(endpoint)[command == "apply" :]  # it has no --live
        require_in_force(endpoint, file, run_program("calib", *words, *server))


@pytest.mark.ci
def test_a_wand_calibration_in_a_fresh_process_is_in_force_on_the_server(tmp_path: Path):
    arena, file = ring(3), tmp_path / "new.yaml"
    save_rig(arena.intrinsics, tmp_path / "lenses.yaml")
    (tmp_path / "wand.yaml").write_text(dump_yaml(arena.wand))
    files = ("--wand", tmp_path / "wand.yaml", "--rig", tmp_path / "lenses.yaml", "--out", file)
    with serving_process(saving(tmp_path)) as (endpoint, _), waving(endpoint, record(arena, 10.0)):
        done = run_program("calib", "wand", *map(str, files), "--seconds", "6", *to_server(endpoint))
        require_in_force(endpoint, file, done)
    assert_near(load_rig(file), arena.truth, 0.01, 0.005)


@pytest.mark.ci
def test_a_rig_that_the_server_can_t_save_is_refused(tmp_path: Path):
    """The command exits with 2 and the reason; the old rig stays in force."""
    settings = msgspec.structs.replace(config(tmp_path), saved_rig=str(tmp_path / "missing" / "rig.yaml"))
    save_rig(OTHER, tmp_path / "mine.yaml")
    with serving_process(settings) as (endpoint, _):
        done = run_program("calib", "apply", "--rig", str(tmp_path / "mine.yaml"), *to_server(endpoint)[1:])
        assert done.returncode == 2
        assert "is not in force; the server refuses it" in done.stderr
        assert len(done.stderr.splitlines()) == 1
        assert rig_of(endpoint).cameras == ARENA.cameras


@pytest.mark.ci
@pytest.mark.computed
def test_without_a_server_commands_exit_with_2_and_one_line(tmp_path: Path):
    """All at once, because each waits for a server until its time is over."""
    save_rig(OTHER, tmp_path / "mine.yaml")
    commands = (
        ("calib", "apply", "--rig", str(tmp_path / "mine.yaml")),
        ("fusion", "robots", "list"),
        ("fusion", "define", "b", "--diameter", "0.12"),
    )
    where = to_server(f"tcp/127.0.0.1:{free_port()}")[1:]
    pipe = {"stderr": subprocess.PIPE, "text": True, "cwd": ROOT}
    started = [subprocess.Popen([sys.executable, "-m", *words, *where], **pipe) for words in commands]
    for process in started:
        with process:
            (line,) = process.communicate(timeout=DEADLINE_S)[1].splitlines()
            assert process.returncode == 2
            assert "no server answers" in line


def test_a_client_that_asks_often_always_gets_the_rig(tmp_path: Path):
    """Above its rate the server refuses: that is no arena without a rig."""
    with serving(config(tmp_path)) as (_, client):
        rigs = [client.rig() for _ in range(round(2 * RIG_ANSWERS_HZ))]
    assert all(rig is not None and rig.cameras == ARENA.cameras for rig in rigs)
