# SPDX-License-Identifier: BSD-3-Clause
"""The commands of docs/recordings.md run in their order, on the recording that is part of the documentation."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from camera_node.foundation.config import example_file
from camera_node.foundation.errors import ConfigError
from fusion.commands.sample import sample
from tests.conftest import free_port
from tests.pages import page, programs
from tests.waiting import DEADLINE_S, MAX_DEADLINE_S
from tests.web.roundel.programs import Program, roundel, roundel_command

SAMPLE, VIEW, *COMMANDS = page("recordings.md")
TRACKED = re.compile(r"^(?:rover|drone): tracked (\d+\.\d)%", re.MULTILINE)
MIN_TRACKED = 98.0  # percent; the page shows what was printed when it was written


@pytest.mark.ci
def test_the_sample_is_processed_cut_and_exported(tmp_path: Path):
    for command in (SAMPLE, *COMMANDS):
        output = roundel(*shlex.split(command)[1:], folder=tmp_path)
        if "replay" in command:
            shares = [float(share) for share in TRACKED.findall(output)]
            assert len(shares) == 2
            assert min(shares) >= MIN_TRACKED
    files = {path.name for path in tmp_path.iterdir()}
    assert files >= {
        "poses.csv",
        "smooth.csv",
        "fused.mcap",
        "part.mcap",
        "part.csv",
        "part-rover.tum",
        "part.c3d",
        "recording.png",
        "apart.png",
    }
    (program,) = programs("recordings.md")
    words = [sys.executable, "-c", program]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=DEADLINE_S, check=True)
    assert "poses of rover" in done.stdout


def test_the_sample_is_shown(tmp_path: Path):
    roundel(*shlex.split(SAMPLE)[1:], folder=tmp_path)
    view = Program(roundel_command(*shlex.split(VIEW)[1:], "--port", str(free_port())), tmp_path)
    try:
        view.until("http://")
    finally:
        assert view.stop() == 0


@pytest.mark.ci
def test_the_commands_that_the_sample_suggests_run(tmp_path: Path):
    said = roundel("sample", "small arena", folder=tmp_path)
    commands = [line.strip() for line in said.splitlines() if line.startswith("  roundel ")]
    assert len(commands) == 6
    for command in commands:
        if "view" not in command:
            roundel(*shlex.split(command)[1:], folder=tmp_path)
    files = {path.name for path in (tmp_path / "small arena").iterdir()}
    assert files >= {"new.yaml", "poses.csv", "recording.png"}


@pytest.mark.ci
def test_the_notebook_runs(tmp_path: Path):
    """Its cells, one after the other, as Jupyter runs them."""
    sample(tmp_path / "sample")
    notebook = json.loads((tmp_path / "sample" / "notebook.ipynb").read_text())
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    words = [sys.executable, "-c", "\n".join(cells)]
    folder = tmp_path / "sample"
    done = subprocess.run(
        words, cwd=folder, capture_output=True, text=True, timeout=MAX_DEADLINE_S, check=True
    )
    apart_mm = [float(value) for value in re.findall(r"([\d.]+) mm from rig\.yaml", done.stdout)]
    assert len(apart_mm) == 6
    assert (
        max(apart_mm) < 5 * 2 * 0.27
    )  # two distances of two centres, each known to 0.27 mm along its worst axis
    assert len(re.findall(r"mm RMS apart in \d+ frame sets", done.stdout)) == 3


def test_the_sample_is_small_and_replaces_nothing(tmp_path: Path):
    files = [path for path in example_file("sample").rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 5e6
    (tmp_path / "sample").mkdir()
    with pytest.raises(ConfigError, match="give the name of a new folder"):
        sample(tmp_path / "sample")
