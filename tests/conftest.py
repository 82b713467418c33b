# SPDX-License-Identifier: BSD-3-Clause
"""What several folders of tests need, and in which order they run where `make test` runs them on all cores."""

import fcntl
import os
import random
import re
import shutil
import signal
import socket
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

import pytest

ROOT = Path(__file__).resolve().parents[1]
WAVE_S = 8.0  # enough for every camera of the demo to see the wand in most of its image

LIVE_FILES = ("test_demo.py", "test_readme.py", "test_lab.py")
PORTS = range(20_000, 30_000)  # below those that Linux, macOS and Windows give away by themselves
_locked_ports: list[IO[str]] = []
BEHIND = 10  # the niceness of tests that only compute

# A shell that runs the tests in the background has them, and the programs that they start, ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)


def is_live(item: pytest.Item) -> bool:
    """Whether a test runs programs or a browser against the clock."""
    fixtures = getattr(item, "fixturenames", ())
    return "endpoint" in fixtures or item.path.parent.name == "web" or item.path.name in LIVE_FILES


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Live tests go first, and one at a time; of others, those of a file share its fixtures."""
    items.sort(key=lambda item: not is_live(item))
    for item in items:
        item.add_marker(pytest.mark.xdist_group("live" if is_live(item) else str(item.path)))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Beside live tests, those that only compute wait: the clock is not theirs."""
    if "PYTEST_XDIST_WORKER" in os.environ and not is_live(item):
        os.nice(max(0, BEHIND - os.nice(0)))


def free_port() -> int:
    """A TCP port of this process alone, until it ends, and of nobody else on this machine as long as it is in use.

    It is not one that the system gives away by itself, to an outgoing connection for instance. A locked file keeps the
    tests of other processes off it.
    """
    for port in random.Random(os.urandom(8)).sample(PORTS, len(PORTS)):
        file = (Path(tempfile.gettempdir()) / f"roundel-test-port-{os.getuid()}-{port}").open("w")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            socket.create_server(("127.0.0.1", port)).close()
        except OSError:
            file.close()
            continue
        _locked_ports.append(file)
        return port
    raise RuntimeError(f"no free port in {PORTS}")


def wait_for_port(port: int, deadline_s: float = 120.0) -> None:
    """Return as soon as somebody listens on a TCP port here; fail loudly when nobody does."""
    end = time.monotonic() + deadline_s
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port), timeout=1).close()
        except OSError:
            assert time.monotonic() < end, "nobody listens"
            time.sleep(0.05)


@pytest.fixture
def endpoint() -> str:
    """A Zenoh endpoint on loopback that is free."""
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """The demo's own scene with a shorter wave, in a folder of its own."""
    folder = tmp_path / "demo"
    shutil.copytree(ROOT / "configs" / "demo", folder)
    path = folder / "scene.yaml"
    text, count = re.subn(r"(?m)^wave_s: *[0-9.]+", f"wave_s: {WAVE_S}", path.read_text())
    assert count == 1
    path.write_text(text)
    return path


@pytest.fixture
def shared_data() -> Callable[[str], Path]:
    """`shared_data("arena_small")`: a recording that lies beside the checkout; skips where it is absent."""

    def find(name: str) -> Path:
        path = ROOT.parent / "shared" / "data" / name
        if not path.exists():
            pytest.skip(f"the recording {name} is not beside this checkout")
        return path

    return find
