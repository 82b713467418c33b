# SPDX-License-Identifier: BSD-3-Clause
"""The commands of docs/recordings.md run in their order, on the recording that is part of the documentation."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

from tests.conftest import ROOT, free_port
from tests.pages import page, programs
from tests.waiting import DEADLINE_S
from tests.web.roundel.programs import Program, roundel, roundel_command

VIEW, *COMMANDS = page("recordings.md")
TRACKED = re.compile(r"^(?:rover|drone): tracked (\d+\.\d)%", re.MULTILINE)
MIN_TRACKED = 98.0  # percent; the page shows what was printed when it was written


def test_the_sample_is_processed_cut_and_exported(tmp_path: Path):
    (tmp_path / "docs").mkdir()
    shutil.copy(ROOT / "docs" / "sample.mcap", tmp_path / "docs")
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    for command in COMMANDS:
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
        "sample.png",
        "apart.png",
    }
    (program,) = programs("recordings.md")
    words = [sys.executable, "-c", program]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=DEADLINE_S, check=True)
    assert "poses of rover" in done.stdout


def test_the_sample_is_shown():
    view = Program(roundel_command(*shlex.split(VIEW)[1:], "--port", str(free_port())), ROOT)
    try:
        view.until("http://")
    finally:
        assert view.stop() == 0
