# SPDX-License-Identifier: BSD-3-Clause
"""The rule for live tests that fail: the second run makes a run green only if the test can pass, and it is named."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

ONCE = """
from pathlib import Path

def first(name):
    path = Path(__file__).with_name(name)
    is_first = not path.exists()
    path.touch()
    return is_first
"""
FAILS_ONCE = ONCE + "def test_once(): assert not first('seen'), 'too late'\n"
DIES_ONCE = ONCE + "import os\ndef test_dies(): os._exit(7) if first('dead') else None\n"
FIXTURE_FAILS_ONCE = (
    ONCE
    + """
import pytest

@pytest.fixture
def session():
    yield
    assert not first('closed'), 'not closed'

def test_closes(session): pass
"""
)


def run(folder: Path, files: dict[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    """A suite with the hooks of this one. Files of the folder `live` are live tests."""
    (folder / "pytest.ini").write_text("[pytest]\naddopts = -p tests.conftest --import-mode=importlib\n")
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")} | {
        "PYTHONPATH": str(ROOT)
    }
    command = [sys.executable, "-m", "pytest", "--dist", "loadgroup", *words]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=280)


def closing_line(done: subprocess.CompletedProcess[str]) -> str:
    return done.stdout.strip().splitlines()[-1].strip("=").rsplit(" in ", 1)[0].strip()


@pytest.mark.ci
def test_a_live_test_that_passes_at_its_second_run_is_unstable_and_the_run_is_green(tmp_path: Path):
    """Whether it failed, its fixture did, or its process died."""
    files = {
        "live/test_late.py": FAILS_ONCE,
        "live/test_fixture.py": FIXTURE_FAILS_ONCE,
        "live/test_death.py": DIES_ONCE,
        "live/test_good.py": "def test_good(): pass\n",
    }
    done = run(tmp_path, files, "--second-run", "-n", "1")
    assert closing_line(done) == "1 passed, 3 unstable", done.stdout
    assert done.returncode == 0
    names = ("late.py::test_once", "fixture.py::test_closes", "death.py::test_dies")
    assert all(f"UNSTABLE live/test_{name}\n" in done.stdout for name in names)
    collected = (tmp_path / "build" / "unstable.txt").read_text()
    assert all(text in collected for text in ("test_once", "too late", "not closed"))


@pytest.mark.ci
def test_a_live_test_that_fails_twice_is_red_and_a_computed_one_has_no_second_run(tmp_path: Path):
    files = {
        "live/test_broken.py": "def test_broken(): assert False, 'broken'\n",
        "live/test_late.py": FAILS_ONCE,
        "sums/test_sum.py": FAILS_ONCE,
    }
    done = run(tmp_path, files, "--second-run", "-n", "0")
    assert closing_line(done) == "2 failed, 1 unstable", done.stdout
    assert done.returncode == 1
    assert "second run, by itself" in done.stdout
    assert "test_sum" not in (tmp_path / "build" / "unstable.txt").read_text()


@pytest.mark.parametrize("words", [("-n", "0"), ("-n", "0", "-x", "--second-run")])
def test_no_second_run_unless_asked_for_or_if_the_run_ends_early(tmp_path: Path, words: tuple[str, ...]):
    done = run(tmp_path, {"live/test_late.py": FAILS_ONCE}, *words)
    assert closing_line(done) == "1 failed", done.stdout
    assert done.returncode in (1, 2)
