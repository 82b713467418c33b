# SPDX-License-Identifier: BSD-3-Clause
"""Runs a program without one of its optional packages."""

import subprocess
import sys

from tests.conftest import ROOT
from tests.waiting import DEADLINE_S


def advice_without(package: str, program: str, *words: str) -> str:
    """The one line with which `python -m program words` ends with exit code 2 where a package is not installed."""
    code = f"import sys; sys.modules[{package!r}] = None; from {program}.__main__ import main; main()"
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    return done.stderr
