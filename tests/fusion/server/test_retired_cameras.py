# SPDX-License-Identifier: BSD-3-Clause
"""A camera that was renamed or forgotten disappears from the status; one that is silent stays."""

from fusion.server.server_statistics import SILENT_S, PipelineStatus, ServerStatistics


def test_a_retired_camera_is_listed_no_more_until_a_camera_has_its_name_again():
    """Its last frames can arrive long after the request, for a busy server; a node with a fixed name asks for none."""
    statistics, second = ServerStatistics(150.0), 10**9
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
