# SPDX-License-Identifier: BSD-3-Clause
"""Runs every command of docs/security.md, with shorter times and a port of the operating system's choice."""

import contextlib
import http.client
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
import tyro

from camera_node.commands.camera_command import JoinArena
from camera_node.foundation.config import load_yaml
from tests.conftest import ROOT, free_port
from tests.security.lab import KEYS, Lab
from tests.waiting import DEADLINE_S, wait_for, wait_for_port
from tests.web.roundel.programs import roundel_command
from web.page_access import Tokens

TEXT = (ROOT / "docs" / "security.md").read_text()
SECTIONS = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", TEXT, re.DOTALL | re.MULTILINE))


def commands(section: str) -> list[str]:
    blocks = re.findall(r"^```sh\n(.*?)^```", SECTIONS[section], re.DOTALL | re.MULTILINE)
    return [line for block in blocks for line in block.splitlines()]


def run(command: str, folder: Path) -> None:
    done = subprocess.run(
        ["sh", "-c", command], cwd=folder, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, f"{command}\n{done.stderr}"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with configs, after the commands that create the files. The server is reached as localhost."""
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    for command in commands("Set-up"):
        if not command.startswith("roundel"):
            run(
                command.replace(" server camera", " localhost camera").replace("0.0.0.0:7447", "127.0.0.1:0"),
                tmp_path,
            )
    return tmp_path


def test_every_command_has_a_test():
    """A command that is added to the page needs a test here."""
    tested = ("sh configs/", "cp configs/", "sed -i ", "roundel server", "roundel camera", "roundel record")
    tested += ("roundel view --host",)
    assert [c for section in SECTIONS for c in commands(section) if not c.startswith(tested)] == []


def test_the_folders_work_as_the_page_says(checkout: Path):
    """The server starts in its folder; a recorder and a camera of the page connect in theirs."""
    server, camera, record = (shlex.split(c) for c in commands("Set-up") if c.startswith("roundel"))
    keys = checkout / "keys"
    with contextlib.ExitStack() as closing:
        lab = Lab(keys, closing)
        assert server[1:] == ["server", "--config", "arena.yaml"], "as Lab starts it"
        tyro.cli(JoinArena, args=camera[2:])  # test_roundel_up.py runs it
        north = lab.session("camera.north")
        recorder = subprocess.Popen(
            roundel_command(*(word.replace("tls/server:7447", lab.endpoint) for word in record[1:])),
            cwd=keys / "viewer",
        )
        closing.callback(recorder.wait, DEADLINE_S)
        closing.callback(recorder.terminate)
        recording = keys / "viewer" / "arena.mcap"
        wait_for(recording.exists)
        assert any(reply.ok for reply in wait_for(lambda: list(north.get(KEYS.clock, timeout=1.0))))


def status(port: int, path: str) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    with contextlib.closing(connection):
        connection.request("GET", path)
        return connection.getresponse().status


def test_the_page_requires_a_token_of_the_file(tmp_path: Path):
    (command,) = commands("The page")
    port = free_port()
    page = subprocess.Popen(
        roundel_command(*shlex.split(command)[1:], "--port", port),
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
    )
    with contextlib.ExitStack() as closing:
        closing.callback(page.wait, 30)
        closing.callback(page.terminate)
        wait_for_port(port)
        tokens = load_yaml(tmp_path / "page_tokens.yaml", Tokens)
        assert [status(port, path) for path in ("/", f"/?token={tokens.viewer}")] == [401, 303]


@pytest.mark.parametrize("section", ["Renewal", "Revocation"])
def test_certificates_are_renewed_and_revoked(checkout: Path, section: str):
    certificate = checkout / "keys" / "camera.north" / "tls" / "member.pem"
    for command in commands(section):
        before = certificate.read_bytes() if certificate.exists() else b""
        run(command.replace(" server camera", " localhost camera"), checkout)
        assert not certificate.exists() or certificate.read_bytes() != before
    assert certificate.exists()
