# SPDX-License-Identifier: BSD-3-Clause
"""The programs as services: reports to systemd, exit codes that decide on a restart, and their system calls."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

from camera_node.foundation.errors import TEMPORARY_FAILURE, USER_ERROR
from tests.conftest import ROOT, free_port
from tests.fusion.serving import config, serving
from tests.processes import run_here
from tests.seccomp import HEADER
from tests.waiting import DEADLINE_S, Inbox, in_thread

pytestmark = pytest.mark.computed

UNITS = ROOT / "configs" / "systemd"
WATCHDOG_S = 0.8
NO_SERVER = "tcp/127.0.0.1:1"
needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None or not HEADER.exists(),
    reason="needs systemd-analyze and x86-64 Linux",
)


@contextlib.contextmanager
def manager(folder: Path) -> Iterator[tuple[Inbox, dict[str, str]]]:
    """What systemd receives, and the environment that makes a program report to it."""
    inbox, address = Inbox(), str(folder / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(address)
        receiver.settimeout(0.1)
        done = threading.Event()

        def receive() -> None:
            while not done.is_set():
                with contextlib.suppress(TimeoutError):
                    inbox.put(receiver.recv(4096).decode())

        with in_thread(receive, done.set):
            yield inbox, {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": str(round(1e6 * WATCHDOG_S))}


def arguments_of(unit: str, folder: Path) -> list[str]:
    """A command line of the program of a service file that needs no other program."""
    if unit == "roundel-fusion":
        (folder / "arena.yaml").write_text(
            f"listen: [tcp/127.0.0.1:0]\nrobots: {ROOT / 'configs' / 'robots.yaml'}\n"
        )
        return ["fusion", "--config", str(folder / "arena.yaml")]
    if unit == "roundel-web":
        return ["web", "--connect", NO_SERVER, "--port", str(free_port())]
    scene = str(ROOT / "configs" / "demo" / "scene.yaml")
    return ["camera_node", "--source", "sim", "--scene", scene, "--name", "east", "--connect", NO_SERVER]


@needs_systemd
@pytest.mark.parametrize(
    "unit",
    [
        "roundel-fusion",
        *(pytest.param(unit, marks=pytest.mark.ci) for unit in ("roundel-web", "roundel-camera@")),
    ],
)
def test_a_service_works_under_its_filter_and_reports(unit: str, tmp_path: Path):
    """Ready, then its state and progress, until SIGTERM ends it with exit code 0."""
    sandbox = [sys.executable, str(ROOT / "tests" / "seccomp.py"), str(UNITS / f"{unit}.service")]
    command = [*sandbox, sys.executable, "-m", *arguments_of(unit, tmp_path)]
    with manager(tmp_path) as (inbox, environment):
        log = (tmp_path / "log").open("w")
        with (
            log,
            subprocess.Popen(
                command, cwd=ROOT, env=os.environ | environment, stdout=log, stderr=log
            ) as process,
        ):
            try:
                assert inbox.until(lambda items: items.count("WATCHDOG=1") >= 3), (
                    tmp_path / "log"
                ).read_text()
                assert inbox.until(lambda items: any(item.startswith("STATUS=") for item in items))
            finally:
                process.send_signal(signal.SIGTERM)
            assert process.wait(DEADLINE_S) == 0
    assert inbox.items.index("READY=1") < inbox.items.index("WATCHDOG=1")
    assert inbox.items[-1] == "STOPPING=1"


def test_a_server_that_is_stuck_reports_no_progress(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Its threads and its session live on, but its loop does not: systemd restarts it."""
    with manager(tmp_path) as (inbox, environment):
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        with serving(config(tmp_path)) as (server, _):
            release, blocked = threading.Event(), threading.Event()
            try:
                assert inbox.until(lambda items: "WATCHDOG=1" in items)
                server.transport.enqueue(lambda: blocked.set() or release.wait(DEADLINE_S))
                assert blocked.wait(DEADLINE_S)
                sent = len(inbox.items)
                assert not inbox.until(lambda items: "WATCHDOG=1" in items[sent:], 2 * WATCHDOG_S)
            finally:
                release.set()


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (
            ["fusion", "--listen", "tcp/192.0.2.1:7447"],
            TEMPORARY_FAILURE,
        ),  # an address of no machine, RFC 5737
        (["fusion", "--listen", "nonsense"], USER_ERROR),
        (["fusion", "--config", "none.yaml"], USER_ERROR),
        (["camera_node", "--source", "/dev/video99", "--name", "north"], TEMPORARY_FAILURE),
        (["camera_node", "--source", "nosuch", "--name", "north"], USER_ERROR),
        (["camera_node", "--source", "sim", "--scene", "none.yaml", "--name", "north"], USER_ERROR),
        (["web", "--host", "192.0.2.1"], TEMPORARY_FAILURE),
        (["web", "--port", "0"], USER_ERROR),
    ],
)
def test_exit_codes_distinguish_mistakes_from_what_may_pass(words: list[str], code: int, tmp_path: Path):
    """The service files restart after all exit codes but 2."""
    (tmp_path / "robots.yaml").write_text((ROOT / "configs" / "robots.yaml").read_text())
    program, *arguments = words
    done = run_here(lambda: import_module(f"{program}.__main__").execute(arguments), tmp_path)
    assert done.returncode == code, done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
