# SPDX-License-Identifier: BSD-3-Clause
"""The log: one line for each message, escaped, and few lines of each kind and process however much happens."""

import io
import logging
import math
import re
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from camera_node.foundation.line_limits import MAX_KINDS, LineLimiter, LogLimits
from camera_node.foundation.logs import LimitedHandler, LineFormatter, about
from tests.waiting import wait_for

FUZZED_S = 1020.0  # of a million fuzzed messages
FAST = LogLimits(pause_s=0.05)
RECORD = {"name": "tested", "levelno": logging.WARNING, "levelname": "WARNING"}
FLOOD = """
import logging, sys
from camera_node.foundation.logs import set_up_logging
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


class VirtualLog:
    """Lines in virtual time, as `LimitedHandler` would write them: (time s, lines that it stands for, text)."""

    def __init__(self, limits: LogLimits | None = None) -> None:
        self.now_s = 0.0
        self.lines: list[tuple[float, int, str]] = []
        self._limiter = LineLimiter(limits, lambda: self.now_s)
        self._due_s: float | None = None

    def log(self, at_s: float, subject: object = None, text: str = "refused: %s") -> None:
        self.advance(at_s)
        record = RECORD | {"msg": text, "args": (len(self.lines),), "subject": subject}
        if self._limiter.hold(logging.makeLogRecord(record)):
            self._write(self._limiter.release())

    def advance(self, until_s: float) -> None:
        while self._due_s is not None and self._due_s <= until_s:
            self.now_s = max(self.now_s, self._due_s)
            self._write(self._limiter.release())
        self.now_s = until_s

    def close(self) -> list[tuple[float, int, str]]:
        """The lines before the end; then what was held back is among them."""
        lines = list(self.lines)
        self._write(self._limiter.release_all())
        return lines

    def _write(self, released: list) -> None:
        for held, record in released:
            self._limiter.charge(held, 1)
            self.lines.append((self.now_s, held, f"{record.levelname} {record.getMessage()}"))
        self._due_s = self._limiter.due_s()


def flooded(kinds: int, hz: float, seconds: float, limits: LogLimits | None = None) -> VirtualLog:
    """Lines of so many kinds, all the time."""
    log = VirtualLog(limits)
    for k in range(round(seconds * hz)):
        log.log(k / hz, k % kinds)
    log.advance(seconds)
    return log


@pytest.mark.parametrize("seconds", [10.0, 100.0, FUZZED_S])
def test_a_flood_of_one_kind_writes_as_many_lines_as_the_logarithm_of_its_duration(seconds: float):
    """Six at once and one a minute before: 23 in the time of a million fuzzed messages."""
    log = flooded(1, 20.0, seconds, LogLimits(most_lines=1))
    times = [at_s for at_s, _, _ in log.close()]
    assert times[0] == 0.0
    assert len(times) <= 2 + math.log(1 + seconds, LogLimits().growth)
    assert np.diff(times) == pytest.approx(
        LogLimits().growth ** np.arange(len(times) - 1), abs=0.1
    )  # 0.05 s between two
    assert sum(held for _, held, _ in log.lines) == round(20.0 * seconds)


@given(st.lists(st.sampled_from([0.0, 0.01, 0.3, 2.0, 7.0, 30.0, 59.0, 61.0, 130.0]), max_size=300))
@settings(max_examples=50)
def test_no_pattern_of_one_kind_writes_more_than_a_flood_and_a_line_a_minute(gaps_s: list[float]):
    """Each quiet time halves the pause, and so permits one more line. None is held back for longer than that."""
    log, limits = VirtualLog(), LogLimits()
    times = np.cumsum(gaps_s).tolist()
    for at_s in times:
        log.log(at_s)
    seconds = times[-1] if times else 0.0
    log.advance(seconds + max(limits.quiet_s, limits.quiet_share * limits.longest_pause_s))
    written = log.close()
    assert sum(held for _, held, _ in written) == len(times)
    assert len(written) <= 3 + math.log2(1 + seconds / limits.pause_s) + seconds / limits.quiet_s


def test_a_state_that_changes_once_a_minute_writes_few_lines():
    """As a camera that comes and goes: 27 lines an hour on average before, with a quiet time of a minute."""
    log = VirtualLog()
    times_s = np.cumsum(np.random.default_rng(1).exponential(60.0, 60))
    for at_s in times_s:
        log.log(at_s)
    log.advance(times_s[-1] + LogLimits().quiet_share * LogLimits().longest_pause_s)
    assert sum(held for _, held, _ in log.lines) == len(times_s)
    assert len(log.lines) <= 16


def test_a_kind_that_was_quiet_for_long_is_written_at_once_again():
    log = flooded(1, 1.0, 1000.0)
    log.advance(3000.0)
    before = len(log.lines)
    log.log(3000.0)
    assert [at_s for at_s, _, _ in log.lines[before:]] == [3000.0]


@pytest.mark.parametrize("kinds", [1, 5, 15, pytest.param(60, marks=pytest.mark.ci)])
def test_lines_under_attack_are_bounded_and_none_is_uncounted(kinds: int):
    """However many kinds: the first line of each, and digests as often as the logarithm of the duration."""
    log, limits = flooded(kinds, 30.0, FUZZED_S), LogLimits()
    first = min(kinds, limits.lines + kinds / 30.0 / limits.line_s)
    assert len(log.close()) <= first + math.log2(1 + FUZZED_S / limits.pause_s) + 2
    assert sum(held for _, held, _ in log.lines) == round(30.0 * FUZZED_S)


def test_an_arena_under_a_million_fuzzed_messages_writes_fewer_than_a_hundred_lines():
    """A server that counts fifteen kinds of faults, and five nodes whose settings are changed; 140 before."""
    assert len(flooded(15, 30.0, FUZZED_S).close()) + 5 * len(flooded(1, 10.0, FUZZED_S).close()) < 100


def test_an_hour_of_attack_writes_fewer_than_a_hundred_lines():
    assert len(flooded(20, 4.0, 3600.0).close()) < 100


def test_a_rare_kind_does_not_write_the_others_of_a_flood():
    """Eight kinds all the time, and eight that recur every half minute: as of a fuzzed camera; 17 digests before."""
    log = VirtualLog()
    for k in range(round(FUZZED_S * 10)):
        log.log(k / 10, k % 8)
        if k % 37 == 0:
            log.log(k / 10, 8 + k // 37 % 8)
    assert len(log.close()) <= 16 + math.log2(1 + FUZZED_S) + LogLimits().separate + 2
    assert sum(held for _, held, _ in log.lines) == round(FUZZED_S * 10) + math.ceil(FUZZED_S * 10 / 37)


def test_an_event_during_a_flood_of_many_kinds_is_written_within_ten_seconds():
    log = VirtualLog()
    for k in range(6000):
        log.log(k / 20, k % 40)
        if k == 4000:
            log.log(200.0, "north", "camera moved %s")
    assert min(at_s for at_s, _, text in log.lines if "camera moved" in text) <= 210.0


def test_events_of_an_arena_are_written_within_a_second():
    """Forty events one after the other, though four lines may be written at once: each is a line of its own."""
    log = VirtualLog(LogLimits(0.0, lines=4))
    for k in range(40):
        log.log(float(k), k, "camera was moved %s")
    log.advance(40.0)
    assert [held for _, held, _ in log.lines] == [1] * 40
    assert all(k <= at_s <= k + 1.0 for k, (at_s, _, _) in enumerate(log.lines))


def test_a_rare_line_is_quoted_in_the_digest_of_a_flood():
    """A camera that fails during an attack is in the next line that may be written."""
    log = VirtualLog(LogLimits(0.0, lines=3, most_lines=10))
    for k in range(4000):
        log.log(k / 1000, k % 40)
    log.log(4.0, "north", "camera north was moved (%s)")
    log.advance(15.0)
    at_s, _, line = next(line for line in log.lines if "north" in line[2])
    assert re.match(
        r"WARNING \d+ lines of \d+ kinds: camera north was moved \(\d+\); refused: \d+ \(\d+ lines like this\); ",
        line,
    )
    assert at_s <= 4.0 + LogLimits().most_lines * LogLimits().line_s
    assert len(log.lines) < 10


def test_ever_new_kinds_are_limited_together():
    """As of a library that formats its messages itself: no memory for each of them."""
    limiter = LineLimiter(LogLimits(pause_s=60.0))
    for k in range(10 * MAX_KINDS):
        limiter.hold(logging.makeLogRecord(RECORD | {"msg": f"message {k}"}))
    assert len(limiter.release_all()) == 1
    assert len(limiter._kinds) <= MAX_KINDS + 1


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
