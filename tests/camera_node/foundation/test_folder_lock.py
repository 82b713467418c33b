# SPDX-License-Identifier: BSD-3-Clause
"""One program at a time saves in a folder: the second one names the first, and a killed one leaves no lock."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from camera_node.foundation.errors import ConfigError
from camera_node.foundation.folder_lock import locked_folder
from tests.conftest import ROOT
from tests.processes import first_line, killed_at_end

HOLDER = """
import sys
from pathlib import Path
from camera_node.foundation.folder_lock import locked_folder
with locked_folder(Path(sys.argv[1]), "server"):
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_the_second_program_names_the_first_and_a_killed_one_leaves_no_lock(tmp_path: Path):
    words = [sys.executable, "-c", HOLDER, str(tmp_path)]
    with killed_at_end(words, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        first_line(holder)
        with (
            pytest.raises(
                ConfigError, match=rf"another server saves in .*: process {holder.pid} on .*end that"
            ),
            locked_folder(tmp_path, "server"),
        ):
            pass
        with locked_folder(tmp_path, "roundel up"):
            pass  # another kind of program
        holder.kill()
        holder.wait()
        with locked_folder(tmp_path, "server"):
            assert f"process {os.getpid()} on " in (tmp_path / ".server.lock").read_text()
    with locked_folder(tmp_path, "server"):
        pass


def test_a_folder_in_which_nothing_can_be_saved_needs_no_lock(tmp_path: Path):
    with locked_folder(tmp_path / "none", "server"), locked_folder(tmp_path / "none", "server"):
        pass
