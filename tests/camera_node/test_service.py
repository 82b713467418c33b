# SPDX-License-Identifier: BSD-3-Clause
"""How programs end on signals: in fresh processes, at the points where an interrupt does harm."""

import signal
import subprocess
import sys

import pytest

from tests.conftest import ROOT
from tests.waiting import DEADLINE_S

# A signal that arrives while the event's own lock is held, as in `Event.wait`.
IN_WAIT = """
import os, signal, sys
from camera_node.service import stopped_by_signals
with stopped_by_signals() as stop:
    with stop._cond:
        os.kill(os.getpid(), int(sys.argv[1]))
    sys.exit(0 if stop.wait(30) else 1)
"""
# The second signal finds the handlers of before.
AFTERWARDS = """
import os, signal, sys
from camera_node.service import stopped_by_signals
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
