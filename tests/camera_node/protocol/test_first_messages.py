# SPDX-License-Identifier: BSD-3-Clause
"""The first messages of a program arrive on several threads at once."""

import subprocess
import sys

# A thread builds what is known of a type when another one decodes its first message of it.
FIRST_MESSAGES = """
import threading
import msgspec
from camera_node.protocol.messages import decode
is_building, has_decoded = threading.Event(), threading.Event()
def integer():
    is_building.set()
    has_decoded.wait(1.0)  # in vain if the other thread waits for this one
    return int
class Inner(msgspec.Struct):
    number: "integer()" = 0
class Message(msgspec.Struct):
    inner: Inner
data = msgspec.msgpack.encode(Message(Inner(1)))
def first():
    assert decode(data, Message).inner.number == 1
def second():
    assert is_building.wait(60.0)
    first()
    has_decoded.set()
threads = [threading.Thread(target=run) for run in (first, second)]
[thread.start() for thread in threads], [thread.join() for thread in threads]
assert has_decoded.is_set()
"""


def test_threads_that_decode_a_kind_first_do_not_crash():
    """A viewer ended with SIGSEGV a second after its start."""
    done = subprocess.run(
        [sys.executable, "-c", FIRST_MESSAGES], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
