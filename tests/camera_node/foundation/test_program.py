# SPDX-License-Identifier: BSD-3-Clause
"""How programs use memory, and how they end; each test runs a program of its own."""

import subprocess
import sys

import pytest

from camera_node.foundation.program import glibc
from tests.waiting import DEADLINE_S

RESIDENT = """
import ctypes, os, threading, time
from camera_node.foundation.program import glibc, return_freed_memory
from tests.benchmarks.faults.memory import anonymous_mb

return_freed_memory(period_s=0.05)
library = glibc()
library.malloc.restype, library.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]

def filled(size):
    pointer = library.malloc(size)
    ctypes.memset(pointer, 1, size)
    return pointer

def report(before, freed_mb):
    end_s = time.monotonic() + 20
    while anonymous_mb(os.getpid()) > before - freed_mb and time.monotonic() < end_s:
        pass
    print(before - anonymous_mb(os.getpid()))
"""

# Of 50 MB in blocks 44 MB are freed. The others, one in ten and the last ones, prevent that the heap shrinks.
FRAGMENTS = """
blocks = [filled(100_000) for _ in range(500)]
before = anonymous_mb(os.getpid())
for k, pointer in enumerate(blocks):
    if k % 10 and k < 490:
        library.free(pointer)
report(before, 40)
"""

# Four threads use 5 MB each for a moment. After a block of 20 MB glibc lets twice as much stay at the end of an arena.
THREADS = """
library.free(filled(20_000_000))
full, measured = threading.Barrier(5), threading.Barrier(5)

def work():
    blocks = [filled(100_000) for _ in range(50)]
    full.wait(20)
    measured.wait(20)
    for pointer in blocks:
        library.free(pointer)

for _ in range(4):
    threading.Thread(target=work).start()
full.wait(20)
before = anonymous_mb(os.getpid())
measured.wait(20)
report(before, 18)
"""

# An end with a thread that would be in the middle of its work, a log line, and output without a line feed.
ENDS = """
import logging, sys, threading
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.program import run

def work():
    while True:
        sum(range(1000))

def program():
    threading.Thread(target=work).start()
    logging.basicConfig()
    print("done", end="")
    logging.warning("logged")
    if sys.argv[1:]:
        raise ConfigError("what to do")

run(program)
"""


def python(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S)


@pytest.mark.skipif(glibc() is None, reason="the allocator is not glibc's")
@pytest.mark.parametrize(
    ("program", "freed_mb"), [(FRAGMENTS, 40), (THREADS, 18)], ids=("fragments", "threads")
)
def test_freed_memory_is_returned(program: str, freed_mb: float):
    """The pages of all freed blocks but those at their ends, whichever thread used them."""
    done = python(RESIDENT + program)
    assert not done.stderr
    assert float(done.stdout) > freed_mb


def test_a_program_ends_with_its_output_and_its_code():
    """Also while a thread runs that does not end."""
    done = python(ENDS)
    assert (done.returncode, done.stdout) == (0, "done")
    assert "logged" in done.stderr
    done = python(ENDS, "fail")
    assert (done.returncode, done.stdout) == (2, "done")
    assert done.stderr.endswith("error: what to do\n")
