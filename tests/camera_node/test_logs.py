# SPDX-License-Identifier: BSD-3-Clause
"""The log: one line for each message, escaped, and one line of a kind in each interval with a count."""

import io
import logging
import re
import subprocess
import sys
from collections.abc import Iterator

import pytest

from camera_node.logs import LONGEST_S, MAX_KINDS, LimitedHandler, LineFormatter, about
from tests.waiting import wait_for

INTERVAL_S = 0.05
FLOOD = """
import logging, sys
from camera_node.logs import set_up_logging
set_up_logging()
log = logging.getLogger("fusion")
for k in range(85_804):
    log.warning("a published rig is refused: %s", k)
log.warning("other")
"""


@pytest.fixture
def stream() -> Iterator[io.StringIO]:
    """What the logger `tested` writes."""
    stream, log = io.StringIO(), logging.getLogger("tested")
    handler = LimitedHandler(stream, INTERVAL_S)
    handler.setFormatter(LineFormatter("%(message)s"))
    log.addHandler(handler)
    log.propagate = False
    yield stream
    log.removeHandler(handler)
    handler.close()


log = logging.getLogger("tested")


def test_a_flood_of_one_kind_is_a_few_lines_with_counts(stream: io.StringIO):
    """All lines are counted: those written, and those that a written one stands for."""
    for k in range(1000):
        log.warning("refused: %d", k)
    log.warning("of another kind")
    wait_for(lambda: "999" in stream.getvalue())
    lines = stream.getvalue().splitlines()
    assert lines[0] == "refused: 0"
    assert "of another kind" in lines
    counts = [int(n) for n in re.findall(r"\((\d+) lines like this\)", stream.getvalue())]
    singles = sum(line.startswith("refused") and "(" not in line for line in lines)
    assert sum(counts) + singles == 1000
    assert len(lines) < 10


def test_a_kind_that_was_silent_is_written_at_once(stream: io.StringIO):
    log.warning("refused: %d", 1)
    log.warning("refused: %d", 2)
    wait_for(lambda: "refused: 2" in stream.getvalue())
    log.warning("appeared: %d", 3)
    assert stream.getvalue().splitlines()[-1] == "appeared: 3"


def test_a_message_is_one_line_without_control_characters(stream: io.StringIO):
    log.warning("camera %s", "x\nERROR all is lost\x1b[2J\x07\u202e")
    assert stream.getvalue() == "camera x\\nERROR all is lost\\x1b[2J\\x07\\u202e\n"


def test_a_traceback_cannot_forge_a_line(stream: io.StringIO):
    try:
        raise RuntimeError("x\nINFO fusion all is well\x1b[0m")
    except RuntimeError:
        log.exception("failed")
    assert all(line.startswith("| ") for line in stream.getvalue().splitlines()[1:])
    assert "\x1b" not in stream.getvalue()


def test_ever_new_kinds_are_limited_together():
    """As of a library that formats its messages itself."""
    stream = io.StringIO()
    handler = LimitedHandler(stream, LONGEST_S)
    for k in range(10 * MAX_KINDS):
        handler.handle(logging.makeLogRecord({"name": "tested", "msg": f"message {k}"}))
    assert len(stream.getvalue().splitlines()) == MAX_KINDS + 1


def test_a_process_that_ends_in_a_flood_tells_the_count():
    """85,804 lines before: one for each fuzzed rig."""
    done = subprocess.run(
        [sys.executable, "-c", FLOOD], capture_output=True, text=True, timeout=60, check=True
    )
    assert len(done.stderr.splitlines()) < 10
    written = [line for line in done.stderr.splitlines() if "refused" in line]
    counts = [int(n) for n in re.findall(r"\((\d+) lines like this\)", done.stderr)]
    assert sum(counts) + sum("(" not in line for line in written) == 85_804


def test_a_line_about_one_camera_holds_back_none_about_another(stream: io.StringIO):
    for name in ("north", "east", "south"):
        log.warning("camera %s is gone", name, extra=about(name))
    assert stream.getvalue().splitlines() == [f"camera {name} is gone" for name in ("north", "east", "south")]
