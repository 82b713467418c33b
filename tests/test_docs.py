# SPDX-License-Identifier: BSD-3-Clause
"""The documentation site builds without a warning, and its first steps are the commands that test_readme.py runs."""

import os
import re
import subprocess
import sys
from pathlib import Path

import yaml

from tests.conftest import ROOT

SHELL = re.compile(r"^```sh\n(.*?)^```", re.DOTALL | re.MULTILINE)


def commands(text: str) -> list[str]:
    return [line for block in SHELL.findall(text) for line in block.splitlines()]


def test_the_site_builds_in_strict_mode(tmp_path: Path):
    """Every link and anchor between pages exists, and every page is in the navigation."""
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(build, cwd=ROOT, env=env, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr, done.stderr
    assert "not included" not in done.stderr, done.stderr
    assert (tmp_path / "first_arena.html").exists()


def test_the_first_arena_has_the_commands_of_the_readme():
    """test_readme.py runs them."""
    known = commands((ROOT / "README.md").read_text())
    steps = commands((ROOT / "docs" / "first_arena.md").read_text())
    assert len(steps) == 7
    assert [step for step in steps if step not in known] == []


def test_every_page_is_reached_from_the_overview():
    """By a link of the navigation in mkdocs.yml."""
    navigation = (ROOT / "mkdocs.yml").read_text()
    assert yaml.safe_load(navigation)["strict"] is True
    missing = [page.name for page in (ROOT / "docs").glob("*.md") if f": {page.name}\n" not in navigation]
    assert missing == []
