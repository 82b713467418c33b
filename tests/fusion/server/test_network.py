# SPDX-License-Identifier: BSD-3-Clause
"""Interrupted and slow links, and a killed server, between processes."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.benchmarks.faults.arena import LiveArena, small_load
from tests.benchmarks.faults.network import Namespaces, why_not
from tests.benchmarks.network import interrupt, interrupt_all, restart_server, squeeze

LOAD = small_load(robots=3)
BACK_S = 2.0  # the acceptance limits of issue 16
RESTART_S = 1.0
MAX_AGE_S = 1.5  # of a frame on a link of 1 Mbit/s: its queue of 0.4 s, and some messages of 0.1 s each


@pytest.fixture
def apart(tmp_path: Path) -> Iterator[tuple[LiveArena, Namespaces]]:
    """An arena whose cameras have network namespaces of their own."""
    if reason := why_not():
        pytest.skip(reason)
    with Namespaces(tuple(LOAD.rig)) as network, LiveArena(tmp_path, LOAD, (), network) as arena:
        arena.wait_until_tracked()
        yield arena, network


@pytest.mark.slow  # namespaces and a loaded machine: python -m tests.benchmarks.network measures them
def test_a_camera_is_used_again_soon_after_its_link_is_up(apart: tuple[LiveArena, Namespaces]):
    """Longer than the interval at which TCP would retry, shorter than Zenoh's own lease."""
    assert interrupt(*apart, "cam1", 7.0).back_s < BACK_S


@pytest.mark.slow  # namespaces and a loaded machine: python -m tests.benchmarks.network measures them
def test_poses_return_soon_after_the_links_of_all_cameras(apart: tuple[LiveArena, Namespaces]):
    """Shorter than the lease, about as long, and longer: TCP, or Zenoh, or both re-establish the connections."""
    outages = [interrupt_all(*apart, tuple(LOAD.rig), seconds) for seconds in (0.7, 1.0, 1.4, 3.0)]
    assert max(outage.server_s for outage in outages) < BACK_S, outages


@pytest.mark.slow  # namespaces and a loaded machine: python -m tests.benchmarks.network measures them
def test_a_slow_link_builds_no_backlog(apart: tuple[LiveArena, Namespaces]):
    """Without a bound of the send buffer, the age rises by 0.6 s in each second."""
    ages = squeeze(*apart, "cam1", 1_000_000, 6.0)
    assert max(ages, default=MAX_AGE_S) < MAX_AGE_S


@pytest.mark.ci
def test_poses_return_within_a_second_of_a_restart(tmp_path: Path):
    """After an absence that is longer than the first intervals of reconnection."""
    with LiveArena(tmp_path, LOAD) as arena:
        arena.wait_until_tracked()
        restart = restart_server(arena, 4.0)
    assert restart.all_s < RESTART_S, restart
