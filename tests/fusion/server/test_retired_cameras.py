# SPDX-License-Identifier: BSD-3-Clause
"""A camera that was renamed or forgotten disappears from the status; one that is silent stays."""

from fusion.server.server_statistics import SILENT_S, PipelineStatus, ServerStatistics


def test_a_retired_camera_is_listed_until_it_is_silent():
    """Its last frames can arrive after the request; a camera that takes the name later is listed again."""
    statistics, second = ServerStatistics(150.0), 10**9
    for name in ("old", "pulled"):
        statistics.count_arrival(name, second, second)
    statistics.retire("old")
    statistics.retire("unknown")
    assert set(statistics.report(2 * second, PipelineStatus()).cameras) == {"old", "pulled"}
    later = second + round(2 * SILENT_S * second)
    assert set(statistics.report(later, PipelineStatus()).cameras) == {"pulled"}
    statistics.count_arrival("old", later, later)
    assert set(statistics.report(later + 9 * second, PipelineStatus()).cameras) == {"old", "pulled"}
