# SPDX-License-Identifier: BSD-3-Clause
"""Setting the system clock of the server's and the cameras' machine changes no pose."""

from pathlib import Path

import numpy as np
import pytest

from camera_node.clocks.host_clock import unix_ahead_ns
from fusion.server.server_clock import ServerClock
from tests.benchmarks.faults.arena import small_load
from tests.benchmarks.faults.judge import MAX_ERROR_M
from tests.benchmarks.faults.live_clocks import drift_live, set_system_clock


@pytest.mark.ci
@pytest.mark.parametrize("ahead_s", [(0.5, -3600.0), pytest.param((-0.5, 3600.0), marks=pytest.mark.slow)])
def test_no_pose_changes_when_the_system_clock_is_set(tmp_path: Path, ahead_s: tuple[float, ...]):
    """Server and cameras are programs whose system clock is set twice while a robot drives at 0.94 m/s."""
    for judged in set_system_clock(tmp_path, ahead_s):
        assert judged.worst_m < MAX_ERROR_M
        assert judged.share > 1 / 3  # on a busy machine frames may be late


def test_the_time_is_unix_time_at_the_start_and_monotonic_since():
    clock = ServerClock()
    assert abs(clock.ahead_ns - unix_ahead_ns()) < 1e6  # two readings of both clocks on a busy machine
    before = clock.now_ns()
    assert clock.reply().monotonic_ahead_ns == clock.ahead_ns
    assert before <= clock.reply().t_ns <= clock.now_ns()


@pytest.mark.slow  # the drift is reported after 15 s
def test_a_camera_that_drifts_by_200_ppm_is_reported_and_makes_no_pose_wrong(tmp_path: Path):
    """Between programs: a camera node whose clock drifts and is set right. The robots drive at 0.5 m/s."""
    outcome = drift_live(tmp_path, 200.0)
    assert outcome.reported_s * 200e-6 * small_load().speed_m_s < 0.0025
    assert np.isfinite(outcome.recovered_s)
    assert outcome.others == ()
    assert outcome.judged.wrong == 0
    assert outcome.judged.share > 0.9
