# SPDX-License-Identifier: BSD-3-Clause
"""Robots that cross the border of two zones: one stream of poses for each, as exact as in one zone."""

import numpy as np
import pytest

from fusion.model.frames import CalibratedFrame
from fusion.protocol.pose_messages import RobotPose
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import Tracker
from tests.fusion.synthetic import PERIOD_NS, TRIANGLE, WIDE, Arena, Motion
from tests.fusion.tracks import errors
from tests.fusion.zone_hall import VirtualHall, VirtualServer, changes, hall, pairs

ZONES = {"west": pairs(0, 1), "east": pairs(2, 3)}
MIDDLE_M = 4.5  # along the hall
ROBOTS = {"a": TRIANGLE, "b": WIDE}
PHASES = (0.0, 0.1, -0.15, 0.12, 0.05, -0.1, 0.17, -0.05)  # of cameras that one server groups as several do
GAP_NS = 50_000_000
STARTED = 8  # frame sets in which zones acquire robots and agree on owners


def swing(half_m: float, speed_m_s: float, y: float) -> Motion:
    """Along the hall to both sides of its middle, at most at a speed."""

    def at(t: float) -> tuple[np.ndarray, np.ndarray]:
        return np.eye(3), np.array([MIDDLE_M + half_m * np.sin(speed_m_s / half_m * t), y, 0.2])

    return at


def arena_of(motions: dict[str, Motion]) -> Arena:
    robots = {name: ROBOTS[name] for name in motions}
    return Arena(robots, motions, cameras=hall(4), phases=PHASES, sigma_px=0.05)


def run(arena: Arena, frames: list[CalibratedFrame]) -> VirtualHall:
    virtual = VirtualHall(ZONES, arena.cameras, arena.robots, PERIOD_NS)
    virtual.run(frames)
    return virtual


def after_start(stream: list[tuple[str, RobotPose]], arena: Arena) -> list[tuple[str, RobotPose]]:
    return [entry for entry in stream if arena.seconds(entry[1].t_ns) > STARTED * PERIOD_NS * 1e-9]


def squared_errors(arena: Arena, poses: list[RobotPose]) -> np.ndarray:
    return (errors(arena, poses)[:, 3:] ** 2).sum(axis=1)


CROSSING = arena_of({"a": swing(1.6, 2.5, 0.3), "b": swing(1.6, -2.2, -0.4)})
CROSSINGS = {"a": 2, "b": 1}  # to the east and back; from the west, where it starts, to the east


@pytest.fixture(scope="module")
def frames() -> list[CalibratedFrame]:
    return CROSSING.frames(82)


@pytest.fixture(scope="module")
def crossed(frames: list[CalibratedFrame]) -> VirtualHall:
    return run(CROSSING, frames)


def test_a_crossing_robot_has_one_stream_without_a_gap(crossed: VirtualHall):
    """Two robots meet near the border. Between two poses are at most 50 ms, no time has two, and a zone's pose follows
    one of the other zone only once for each crossing."""
    for robot, stream in crossed.streams().items():
        stream = after_start(stream, CROSSING)
        times = np.array([pose.t_ns for _, pose in stream])
        assert np.diff(times).max() < GAP_NS
        assert np.diff(times).min() > 0.2 * PERIOD_NS
        assert all(pose.state == "tracked" for _, pose in stream)
        assert changes(stream) == CROSSINGS[robot]


def test_errors_are_those_of_one_zone(crossed: VirtualHall, frames: list[CalibratedFrame]):
    """The same detections are used at nearly the same times: mean squared errors differ by less than a tenth."""
    one = Tracker(CROSSING.cameras, CROSSING.robots)
    synchronizer = FrameSynchronizer(PERIOD_NS)
    for frame in frames:
        synchronizer.add(frame)
    alone = [pose for frame_set in synchronizer.finish() for pose in one.track(frame_set).poses]
    alone = [pose for pose in alone if CROSSING.seconds(pose.t_ns) > STARTED * PERIOD_NS * 1e-9]
    poses = [pose for s in crossed.streams().values() for _, pose in after_start(s, CROSSING)]
    zoned = squared_errors(CROSSING, poses)
    in_one = squared_errors(CROSSING, alone)
    assert zoned.max() < 5e-3**2, "no swap"
    assert zoned.mean() < 1.1 * in_one.mean()


def test_a_robot_that_moves_about_the_border_stays_with_its_owner():
    """Between places where one zone's cameras determine it with half the variance of the other's."""
    arena = arena_of({"a": swing(0.15, 1.0, 0.2)})
    (stream,) = run(arena, arena.frames(45)).streams().values()
    assert changes(after_start(stream, arena)) == 0


@pytest.mark.ci
def test_the_neighbour_of_a_killed_server_takes_its_robots():
    """Both robots are in the east: one near the border, which the west tracks along, one at the far end, which no
    camera of the west sees. The first has no gap above two frame sets, the second is tracked within a second."""
    arena = arena_of({"a": swing(0.3, 0.5, 0.3), "b": swing(0.2, 0.5, -0.4)})
    near, far = arena.motions["a"], arena.motions["b"]
    arena.motions["a"] = lambda t: (near(t)[0], near(t)[1] + [0.9, 0, 0])
    arena.motions["b"] = lambda t: (far(t)[0], far(t)[1] + [4.5, 0, 0])
    frames = arena.frames(50)
    virtual = VirtualHall(ZONES, arena.cameras, arena.robots, PERIOD_NS)
    virtual.run(frames[: len(frames) // 2])
    dead: VirtualServer = virtual.servers["east"]
    assert {pose.robot for pose in dead.poses[-2:]} == {"a", "b"}
    followers = virtual.servers["west"].tracker.table
    assert [name for name, is_alive in zip(followers.names, followers.alive, strict=True) if is_alive] == [
        "a"
    ]
    virtual.kill("east")
    virtual.run(frames[len(frames) // 2 :])
    streams = virtual.streams(dead)
    for robot, limit_ns in (("a", 2 * PERIOD_NS), ("b", 10**9)):
        poses = [pose for _, pose in after_start(streams[robot], arena)]
        times = np.array([pose.t_ns for pose in poses])
        assert np.diff(times).max() <= limit_ns
        assert times[-1] > frames[-1].t_ns - 2 * PERIOD_NS
        assert squared_errors(arena, poses).max() < 5e-3**2
        assert streams[robot][-1][0] == "west"
