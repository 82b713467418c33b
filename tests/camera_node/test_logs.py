# SPDX-License-Identifier: BSD-3-Clause
"""The log: one line for each message, escaped, and few lines of each kind and process however much happens."""

import io
import logging
import re
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from camera_node.logs import MAX_KINDS, LimitedHandler, LineFormatter, LogLimits, about
from tests.waiting import repeating, wait_for

FAST = LogLimits(spacing_s=0.05)
RECORD = {"name": "tested", "levelno": logging.WARNING, "levelname": "WARNING"}
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
    handler = LimitedHandler(stream, FAST)
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


def lines_counted(text: str) -> int:
    """How many lines the written ones stand for."""
    count = 0
    for line in text.splitlines():
        digest = re.match(r"(\d+) lines of \d+ kinds: ", line)
        counted = re.search(r"\((\d+) lines like this\)$", line)
        count += int(digest[1]) if digest else int(counted[1]) if counted else 1
    return count


def attacked(limits: LogLimits, kinds: int, seconds: float) -> tuple[str, int]:
    """What a handler writes while lines of so many kinds arrive all the time, and how many arrived."""
    stream = io.StringIO()
    handler, sent = LimitedHandler(stream, limits), [0]
    handler.setFormatter(LineFormatter("%(message)s"))

    def send() -> None:
        for k in range(kinds):
            handler.handle(logging.makeLogRecord(RECORD | {"msg": "camera %s", "args": (k,), "subject": k}))
            sent[0] += 1

    with repeating(send, 0.001):
        end_s = time.monotonic() + seconds
        wait_for(lambda: time.monotonic() > end_s)
    handler.close()
    return stream.getvalue(), sent[0]


@pytest.mark.parametrize("kinds", [1, 5, 60])
def test_lines_under_attack_are_bounded_and_none_is_uncounted(kinds: int):
    """However many kinds and messages: those at once, one each time of the refill, and one at the end."""
    limits, seconds = LogLimits(0.001, kind_lines=4, kind_s=0.1, lines=12, line_s=0.005, most_lines=10), 0.5
    text, sent = attacked(limits, kinds, seconds)
    of_kinds = kinds * (limits.kind_lines + seconds / limits.kind_s)
    of_process = limits.lines + seconds / (limits.line_s * limits.most_lines)
    assert (
        len(text.splitlines()) <= min(of_kinds, of_process) * 1.3 + 1
    )  # a busy machine takes longer than `seconds`
    assert lines_counted(text) == sent


def test_the_real_limits_leave_an_hour_of_attack_below_a_hundred_lines():
    limits = LogLimits()
    assert limits.lines + 3600 / (limits.line_s * limits.most_lines) < 100


def test_events_of_an_arena_are_written_within_a_second(stream: io.StringIO):
    """Forty events one after the other, though four lines may be written at once: each is a line of its own."""
    log.handlers[0].close()
    handler = LimitedHandler(stream, LogLimits(0.0, lines=4, line_s=0.01))
    handler.setFormatter(LineFormatter("%(message)s"))
    log.handlers[:] = [handler]
    for k in range(40):
        log.warning("camera %s was moved", k, extra=about(str(k)))
        wait_for(lambda k=k: f"camera {k} was moved" in stream.getvalue(), deadline_s=1.0)


def test_a_rare_line_is_quoted_in_the_digest_of_a_flood(stream: io.StringIO):
    """A camera that fails during an attack is in the next line that may be written."""
    log.handlers[0].close()
    handler = LimitedHandler(stream, LogLimits(0.0, kind_lines=1000, lines=3, line_s=0.01, most_lines=10))
    handler.setFormatter(LineFormatter("%(levelname)s %(message)s"))
    log.handlers[:] = [handler]
    for k in range(4000):
        log.warning("refused: %d", k, extra=about(str(k % 40)))
    log.warning("camera %s was moved", "north")
    wait_for(lambda: "north" in stream.getvalue())
    line = next(line for line in stream.getvalue().splitlines() if "north" in line)
    assert re.match(
        r"WARNING \d+ lines of \d+ kinds: camera north was moved; refused: \d+ \(\d+ lines like this\); ",
        line,
    )
    handler.close()
    assert len(stream.getvalue().splitlines()) < 10


def test_ever_new_kinds_are_limited_together():
    """As of a library that formats its messages itself: no memory for each of them."""
    handler = LimitedHandler(io.StringIO(), LogLimits(spacing_s=60.0))
    for k in range(10 * MAX_KINDS):
        handler.handle(logging.makeLogRecord(RECORD | {"msg": f"message {k}"}))
    assert len(handler._kinds) <= MAX_KINDS + 1
    handler.close()


def test_a_process_that_ends_in_a_flood_tells_the_count():
    """85,804 lines before: one for each fuzzed rig."""
    done = subprocess.run(
        [sys.executable, "-c", FLOOD], capture_output=True, text=True, timeout=60, check=True
    )
    assert len(done.stderr.splitlines()) < 10
    assert lines_counted(done.stderr) == 85_804 + 1


def test_a_line_about_one_camera_holds_back_none_about_another(stream: io.StringIO):
    for name in ("north", "east", "south"):
        log.warning("camera %s is gone", name, extra=about(name))
    assert stream.getvalue().splitlines() == [f"camera {name} is gone" for name in ("north", "east", "south")]
