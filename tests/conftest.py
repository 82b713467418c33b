# SPDX-License-Identifier: BSD-3-Clause
"""Fixtures of several folders, and the order of the tests when `make test` runs them on all cores."""

import fcntl
import functools
import os
import random
import re
import shutil
import signal
import socket
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import hypothesis
import pytest

from tests.second_run import SecondRun

ROOT = Path(__file__).resolve().parents[1]
WAND_S = 8.0  # in this time each camera of the demo sees the wand in most of its image

LIVE_FOLDERS = (
    "web",
    "bridges",
    "client",
    "demo",
    "live",
    "node",
    "protocol",
    "security",
    "server",
    "state",
    "storage",
)
LIVE_FILES = (
    "test_demo.py",
    "test_readme.py",
    "test_lab.py",
    "test_services.py",
    "test_faults.py",
    "test_exact_replay.py",
    "test_health.py",
    "test_record.py",
    "test_publish.py",
)
PORTS = range(20_000, 30_000)  # below the ephemeral ports of Linux, macOS and Windows
_reserved_ports: set[int] = set()
PAGE_NICENESS, NICENESS = 5, 10  # of tests with a browser, and of those that only compute
SLOW_TIMEOUT_S = 3600

# Else pytest rewrites all tests in each process, and each program that a test starts compiles itself: a container that
# sets the variable doubles the time of both.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Examples are the same in each run, and none has a limit of wall-clock time: other tests load the machine.
hypothesis.settings.register_profile("roundel", deadline=None, derandomize=True)
hypothesis.settings.load_profile("roundel")

# A shell that runs the tests in the background makes them, and the programs that they start, ignore SIGINT.
signal.signal(signal.SIGINT, signal.default_int_handler)


def is_live(item: pytest.Item) -> bool:
    """Whether the result of a test depends on real time: it runs sessions, programs or a browser."""
    fixtures = getattr(item, "fixturenames", ())
    if item.get_closest_marker("computed"):
        return False
    in_live_file = item.path.parent.name in LIVE_FOLDERS or item.path.name in LIVE_FILES
    return "endpoint" in fixtures or in_live_file


def is_of_page(item: pytest.Item) -> bool:
    """Whether a live test draws the page, most of them for a browser: it waits as long as that takes."""
    return is_live(item) and item.path.parent == ROOT / "tests" / "web"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--second-run", action="store_true", help="run a live test that failed once more, by itself"
    )
    parser.addoption("--live-only", action="store_true", help="deselect the tests that only compute")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("second_run") and "PYTEST_XDIST_WORKER" not in os.environ:
        config.pluginmanager.register(SecondRun(config))


def pytest_xdist_auto_num_workers() -> int:
    """One process for live tests, which wait for half of their time, and one for each processor."""
    has_affinity = hasattr(os, "sched_getaffinity")  # on Linux
    return (len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1) + 1


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Run live tests first, one at a time but for those of the page, beside which another one runs.

    Other tests of one file run in one process, which shares fixtures. A slow test gets more time before it counts as
    hanging.
    """
    if config.getoption("live_only"):
        config.hook.pytest_deselected(items=[item for item in items if not is_live(item)])
        items[:] = filter(is_live, items)
    items.sort(key=lambda item: (not is_live(item), is_of_page(item)))
    for item in items:
        group = "page" if is_of_page(item) else "live" if is_live(item) else str(item.path)
        item.add_marker(pytest.mark.xdist_group(group))
        if item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.timeout(SLOW_TIMEOUT_S))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Give live tests priority over those of the page, and both over tests that only compute."""
    niceness = PAGE_NICENESS if is_of_page(item) else 0 if is_live(item) else NICENESS
    if "PYTEST_XDIST_WORKER" in os.environ:
        os.nice(max(0, niceness - os.nice(0)))


def free_port() -> int:
    """Return a TCP port that is reserved for this process until it ends.

    It is outside the ephemeral range, so the operating system does not assign it to an outgoing connection. A locked
    byte of a file reserves it against the tests of other processes.
    """
    for port in random.Random(os.urandom(8)).sample(PORTS, len(PORTS)):
        if port in _reserved_ports:  # a process's own locks do not stop it
            continue
        try:
            fcntl.lockf(_port_locks(), fcntl.LOCK_EX | fcntl.LOCK_NB, 1, port)
            socket.create_server(("127.0.0.1", port)).close()
        except OSError:
            continue
        _reserved_ports.add(port)
        return port
    raise RuntimeError(f"no free port in {PORTS}")


@functools.cache
def _port_locks() -> int:
    """The open file whose bytes are locked; it stays open, because closing it would end all locks of this process."""
    path = Path(tempfile.gettempdir()) / f"roundel-test-ports-{os.getuid()}"
    return os.open(path, os.O_RDWR | os.O_CREAT, 0o600)


@pytest.fixture
def endpoint() -> str:
    """A Zenoh endpoint on loopback with a reserved port."""
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A copy of the demo's scene with a shorter wand session."""
    folder = tmp_path / "demo"
    shutil.copytree(ROOT / "configs" / "demo", folder)
    path = folder / "scene.yaml"
    text, count = re.subn(r"(?m)^wave_s: *[0-9.]+", f"wave_s: {WAND_S}", path.read_text())
    assert count == 1
    path.write_text(text)
    return path


@pytest.fixture
def shared_data() -> Callable[[str], Path]:
    """`shared_data("arena_small")` returns a recording beside the checkout; skips if it is absent."""

    def find(name: str) -> Path:
        path = ROOT.parent / "shared" / "data" / name
        if not path.exists():
            pytest.skip(f"the recording {name} is not beside this checkout")
        return path

    return find
