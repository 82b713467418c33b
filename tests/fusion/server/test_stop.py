# SPDX-License-Identifier: BSD-3-Clause
"""A server that is stopped at a point where Python or NumPy loses exceptions ends all the same."""

import signal
import sys
from pathlib import Path

import pytest

from tests.fusion.serving import config
from tests.processes import killed_at_end
from tests.waiting import DEADLINE_S

# Python ignores exceptions in callbacks of the garbage collector, which the server calls between frame sets.
PROGRAM = """
import gc, os, runpy, sys
number = int(sys.argv.pop(1))
def stop(phase, info):
    if os.path.exists(sys.argv[-1]):
        os.kill(os.getpid(), number)
gc.callbacks.append(stop)
runpy.run_module("fusion", run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.ci)])
def test_a_signal_during_garbage_collection_ends_the_server(tmp_path: Path, number: signal.Signals):
    """Before: the interrupt was ignored, and the server served for ever."""
    settings = config(tmp_path)
    files = ["--rig", str(settings.rig), "--robots", settings.robots]
    words = ["--arena", "test", "--listen", "tcp/127.0.0.1:0", *files, "--endpoints-file", "endpoints"]
    command = [sys.executable, "-c", PROGRAM, str(int(number)), *words]
    with killed_at_end(command, cwd=tmp_path) as process:
        assert process.wait(DEADLINE_S) == 0
