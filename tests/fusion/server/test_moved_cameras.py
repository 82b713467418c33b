# SPDX-License-Identifier: BSD-3-Clause
"""A camera that was moved is in the next status, although it is recalibrated within a fraction of a second."""

from fusion.server.status import PipelineStatus, ServerStatistics


def test_a_camera_that_was_excluded_between_two_statuses_is_reported_once():
    statistics, second = ServerStatistics(150.0), 10**9
    for name in ("moved", "other"):
        statistics.count_arrival(name, second, second)
    statistics.note_moved("moved")
    excluded = {n: c.excluded for n, c in statistics.report(2 * second, PipelineStatus()).cameras.items()}
    assert excluded == {"moved": True, "other": False}
    again = statistics.report(3 * second, PipelineStatus())
    assert not again.cameras["moved"].excluded
    lasting = statistics.report(4 * second, PipelineStatus(excluded=frozenset({"moved"})))
    assert lasting.cameras["moved"].excluded
