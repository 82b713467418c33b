# SPDX-License-Identifier: BSD-3-Clause
"""`roundel up` and `roundel camera` in an arena that is protected by certificates, as docs/security.md describes."""

import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.conftest import ROOT, free_port
from tests.security.lab import certificates
from tests.waiting import wait_for_port
from tests.web.roundel.programs import Program, roundel_command, roundel_process

CONTRAST = ("--min-contrast", 40)


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """Certificates of a server, a camera, a viewer and an operator; the server's folder is one of `roundel up`."""
    folder = tmp_path / "keys"
    certificates(folder, "localhost", "camera.south", "viewer", "operator").check_returncode()
    shutil.copy(ROOT / "configs" / "arena.yaml", folder / "server")
    shutil.copy(ROOT / "configs" / "robots.yaml", folder / "server")
    arena = folder / "server" / "arena.yaml"
    lines = arena.read_text().splitlines()
    listen = [f"listen: [tls/127.0.0.1:{free_port()}]", "zenoh: zenoh/server.json5"]
    arena.write_text("\n".join([*listen, *(line for line in lines if not line.startswith("listen:"))]))
    return folder


@pytest.fixture
def running(keys: Path) -> Iterator[tuple[Program, Program, str]]:
    """`roundel up` with its page and a camera of its own, `roundel camera` with a certificate, and the endpoint."""
    endpoint = (keys / "server" / "arena.yaml").read_text().split("[")[1].split("]")[0]
    endpoint, port = endpoint.replace("127.0.0.1", "localhost"), free_port()
    up = Program(
        roundel_command("up", "server", "--port", port, "--source", "sim:north"), keys
    )  # from another folder: paths of certificates are relative to that of the arena
    south = ("--source", "sim:south", "--name", "south", "--connect", endpoint, "--zenoh", "member.json5")
    camera = Program(roundel_command("camera", *south), keys / "camera.south")
    try:
        wait_for_port(port)
        yield up, camera, endpoint
    finally:
        camera.stop()
        up.stop()


@pytest.mark.ci
def test_all_programs_work_with_their_certificates(running: tuple[Program, Program, str], keys: Path):
    """An operator changes the settings of both cameras, a viewer none; without a certificate no program connects."""
    up, camera, endpoint = running
    up.until("camera north publishes")
    camera.until("camera south publishes")
    up.until("camera south appeared")
    member = ("--connect", endpoint, "--zenoh", "member.json5")
    with ThreadPoolExecutor() as pool:  # each refused command waits for an answer until its time is over
        refused = {
            name: pool.submit(roundel_process, "settings", name, *member, folder=keys / "viewer")
            for name in ("north", "south")
        }
        bare = ("cameras", "list", "--connect", endpoint)
        unknown = pool.submit(roundel_process, *bare, folder=keys)
        for name in ("north", "south"):
            done = roundel_process("settings", name, *CONTRAST, *member, folder=keys / "operator")
            assert "min_contrast: 40" in done.stdout
        assert "north" in roundel_process("cameras", "list", *member, folder=keys / "viewer").stdout
        for name, answer in refused.items():
            assert answer.result().returncode == 2
            assert f"camera '{name}' does not answer" in answer.result().stderr
        assert unknown.result().returncode == 2
        assert "error: " in unknown.result().stderr
    assert camera.stop() == 0
    assert up.stop() == 0
