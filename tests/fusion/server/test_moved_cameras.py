# SPDX-License-Identifier: BSD-3-Clause
"""A camera that was moved is in the next status, although it is recalibrated within a fraction of a second; one that
returns has the pose of its calibration."""

import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from fusion.server.server_statistics import PipelineStatus, ServerStatistics
from tests.benchmarks.faults.arena import small_load
from tests.benchmarks.faults.virtual_arena import VirtualArena
from tests.benchmarks.faults.world import CameraFault
from tests.benchmarks.fusion_load import Load

pytestmark = pytest.mark.computed
TURNS = [
    (0.04, -0.03, 0.02),
    (-0.03, 0.02, 0.04),
    (0.03, 0.04, -0.03),
    (-0.02, -0.04, 0.03),
    (0.04, 0.02, 0.02),
]


@pytest.fixture(scope="module")
def arena(tmp_path_factory: pytest.TempPathFactory) -> Iterator[VirtualArena]:
    """Four calibrated cameras and ten robots, which are tracked. Each test moves cameras of its own, and moves them
    back."""
    with VirtualArena(tmp_path_factory.mktemp("arena"), small_load()) as arena:
        arena.wait(3.0)
        yield arena


def turn(
    arena: VirtualArena, camera: str, turn_rad: tuple[float, float, float], seconds: float = 2.0
) -> list[str]:
    """Turn a camera from its calibrated pose, and wait; returns the lines about moved cameras."""
    arena.new_lines()
    arena.place(camera, replace(CameraFault(turn_rad=turn_rad), since_ns=arena.clock.now_ns()))
    arena.wait(seconds)
    return [line for _, line in arena.new_lines() if "moved" in line or "used again" in line]


def is_calibrated(arena: VirtualArena, camera: str) -> bool:
    """Whether the server uses the pose of the calibration."""
    return arena.server.pipeline.cameras[camera].T_world_cam == arena.load.rig[camera].T_world_cam


@pytest.mark.ci
@pytest.mark.parametrize("times", [2, pytest.param(len(TURNS), marks=pytest.mark.slow)])
def test_a_camera_that_returns_has_its_calibrated_pose_however_often_it_was_moved(
    arena: VirtualArena, times: int
):
    """Also if the server restarted: it reads the poses before its corrections from the history of the rig."""
    for k, turned in enumerate(TURNS[:times]):
        assert any("recalibrated" in line for line in turn(arena, "cam1", turned))
        assert not is_calibrated(arena, "cam1")
        if k == times - 1:
            arena.restart()
            arena.wait(2.0)
        assert any("known pose" in line for line in turn(arena, "cam1", (0.0, 0.0, 0.0)))
        assert is_calibrated(arena, "cam1")


@pytest.mark.ci
def test_recalibrations_do_not_add_up(arena: VirtualArena):
    """While one camera is at a pose that is known to a millimetre, another one returns to that of its calibration."""
    turn(arena, "cam0", TURNS[0])
    turn(arena, "cam2", TURNS[1])
    turn(arena, "cam2", (0.0, 0.0, 0.0))
    turn(arena, "cam0", (0.0, 0.0, 0.0))
    assert is_calibrated(arena, "cam0")
    assert is_calibrated(arena, "cam2")


def test_a_camera_that_is_shaken_has_its_pose_again(arena: VirtualArena):
    """It is back before its frames determine another pose."""
    lines = turn(arena, "cam3", TURNS[2], 0.75)
    lines += turn(arena, "cam3", (0.0, 0.0, 0.0))
    assert any("was moved" in line for line in lines)
    assert any("known pose" in line for line in lines)
    assert is_calibrated(arena, "cam3")


def test_a_camera_that_was_excluded_between_two_statuses_is_reported_once():
    statistics, second = ServerStatistics(), 10**9
    for name in ("moved", "other"):
        statistics.count_arrival(name, second, second)
    statistics.note_moved("moved")
    excluded = {n: c.excluded for n, c in statistics.report(2 * second, PipelineStatus()).cameras.items()}
    assert excluded == {"moved": True, "other": False}
    again = statistics.report(3 * second, PipelineStatus())
    assert not again.cameras["moved"].excluded
    lasting = statistics.report(4 * second, PipelineStatus(excluded=frozenset({"moved"})))
    assert lasting.cameras["moved"].excluded


@pytest.mark.slow
def test_robots_do_not_follow_a_camera_that_is_shifted(tmp_path: Path):
    """Three cameras with frames at different times: an image that is off by 6 px looks like velocities. Robots stay
    nearer to the truth than the camera was shifted."""
    shift_m = (-0.006, -0.010, -0.016)
    load = Load(robots=4, cameras=3, hz=30.0, speed_m_s=0.5, crossing=True)
    with VirtualArena(tmp_path, load) as arena:
        arena.wait(3.0)
        arena.judge.forget()
        arena.place("cam2", CameraFault(shift_m=shift_m, since_ns=arena.clock.now_ns()))
        arena.wait(1.5)
        assert arena.judge.count > 0
        assert arena.judge.largest_m < math.dist(shift_m, (0.0, 0.0, 0.0))
