# SPDX-License-Identifier: BSD-3-Clause
"""How programs end on signals: in fresh processes, at the points where an interrupt does harm."""

import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_node.foundation.service import StopEvent
from tests.conftest import ROOT
from tests.processes import running
from tests.waiting import DEADLINE_S

# A signal that arrives while the event's own lock is held, as in `Event.wait`.
IN_WAIT = """
import os, signal, sys
from camera_node.foundation.service import stopped_by_signals
with stopped_by_signals() as stop:
    with stop._cond:
        os.kill(os.getpid(), int(sys.argv[1]))
    sys.exit(0 if stop.wait(30) else 1)
"""
# The second signal finds the handlers of before.
AFTERWARDS = """
import os, signal, sys
from camera_node.foundation.service import stopped_by_signals
number = int(sys.argv[1])
for _ in range(3):
    with stopped_by_signals() as stop:
        os.kill(os.getpid(), number)
        assert stop.wait(30)
received = []
signal.signal(number, lambda number, frame: received.append(number))
with stopped_by_signals() as stop:
    pass
os.kill(os.getpid(), number)
sys.exit(0 if received == [number] and not stop.is_set() else 1)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
@pytest.mark.parametrize("program", [IN_WAIT, AFTERWARDS], ids=["in wait", "afterwards"])
def test_a_signal_sets_the_event_wherever_it_arrives(program: str, number: signal.Signals):
    command = [sys.executable, "-c", program, str(int(number))]
    assert subprocess.run(command, cwd=ROOT, timeout=DEADLINE_S, check=False).returncode == 0


def test_what_is_to_be_closed_with_the_event_is_closed_once():
    """Within the block, or at its beginning if the event was set before; not after it."""
    stop, closed = StopEvent(), []
    with stop.closing(lambda: closed.append("before")):
        pass
    with stop.closing(lambda: closed.append("within")):
        stop.set()
        stop.set()
    with stop.closing(lambda: closed.append("after")):
        pass
    assert closed == ["within", "after"]


def test_a_camera_that_delivers_no_frame_ends_on_a_signal(tmp_path: Path):
    """Its program waits for the next frame of a recording with a pause of an hour."""
    for t_ns in (0, 3600 * 10**9):
        cv2.imwrite(str(tmp_path / f"{t_ns}.png"), np.zeros((48, 64), np.uint8))
    words = ["--source", tmp_path, "--name", "cam0", "--listen", "tcp/127.0.0.1:0"]
    with running("camera_node", *words, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "cam0" in process.stderr.readline()
