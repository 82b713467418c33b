# SPDX-License-Identifier: BSD-3-Clause
"""A camera that was renamed or forgotten disappears from the status; one that is silent stays. A state that
lasts is logged once."""

import logging

import pytest

from fusion.server.server_statistics import LOGGED_LATE, ON_TIME_S, SILENT_S, PipelineStatus, ServerStatistics


def test_a_retired_camera_is_listed_no_more_until_a_camera_has_its_name_again():
    """Its last frames can arrive long after the request, for a busy server; a node with a fixed name asks for none."""
    statistics, second = ServerStatistics(), 10**9
    for name in ("old", "pulled"):
        statistics.count_arrival(name, second, second)
    statistics.retire("old")
    statistics.retire("unknown")
    assert set(statistics.report(2 * second, PipelineStatus()).cameras) == {"pulled"}
    later = second + round(2 * SILENT_S * second)
    statistics.report(later, PipelineStatus())
    statistics.count_arrival("old", 2 * second, later)
    assert set(statistics.report(later, PipelineStatus()).cameras) == {"pulled"}
    statistics.count_arrival("old", later + second, later + second)
    assert set(statistics.report(later + second, PipelineStatus()).cameras) == {"old", "pulled"}
    statistics.retire("old")
    statistics.retire("old", False)
    assert set(statistics.report(later + 9 * second, PipelineStatus()).cameras) == {"old", "pulled"}


def test_a_camera_that_is_late_now_and_then_is_told_twice(caplog: pytest.LogCaptureFixture):
    """Every second frame for a minute: one line at the begin, one after the end with the number of frames."""
    statistics, period_ns = ServerStatistics(), 10**8
    caplog.set_level(logging.INFO, "fusion")
    for k in range(1, 1 + round((60 + 2 * ON_TIME_S) * 10)):
        is_late = k <= 600 and k % 2 == 0
        t_ns = k * period_ns
        statistics.count_arrival("cam0", t_ns, t_ns)
        if is_late:
            statistics.note_late("cam0", 390.0, 150.0)
        else:
            statistics.note_on_time("cam0")
    told = [record.getMessage() for record in caplog.records if "appeared" not in record.getMessage()]
    assert told == [
        "cam0 is 390 ms late (limit 150 ms); its late frames are dropped",
        "cam0 is on time again: 300 of its frames in 60 s were too late and were dropped",
    ]
    for _ in range(LOGGED_LATE):
        statistics.note_late("cam0", 390.0, 150.0)
    assert "390 ms late" in caplog.records[-1].getMessage()


def test_single_late_frames_are_counted_and_not_logged(caplog: pytest.LogCaptureFixture):
    """A busy machine delays one frame a minute for days: that is no state of the camera."""
    statistics, second = ServerStatistics(), 10**9
    caplog.set_level(logging.INFO, "fusion")
    last = 10 * round(2 * ON_TIME_S)
    for k in range(1, 1 + last):
        statistics.count_arrival("cam0", k * second, k * second)
        if k % round(2 * ON_TIME_S) == 0:
            statistics.note_late("cam0", 390.0, 150.0)
        else:
            statistics.note_on_time("cam0")
    assert statistics.report(last * second, PipelineStatus()).cameras["cam0"].late == 10
    assert [record.getMessage() for record in caplog.records] == ["camera cam0 appeared"]


def test_frames_that_come_after_later_ones_are_not_said_to_exceed_the_limit(caplog: pytest.LogCaptureFixture):
    statistics = ServerStatistics()
    statistics.count_arrival("cam0", 10**9, 10**9)
    for _ in range(LOGGED_LATE):
        statistics.note_late("cam0", 60.0, 150.0)
    assert caplog.records[-1].getMessage() == (
        "cam0: a frame came after later ones, 60 ms old; such frames are dropped"
    )
