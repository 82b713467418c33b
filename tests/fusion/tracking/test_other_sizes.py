# SPDX-License-Identifier: BSD-3-Clause
"""Markers of sizes that no robot declares are reported, and wrong declared sizes are noticed."""

import msgspec
import numpy as np
import pytest

from fusion.model.robots import Robot
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.result import TrackingResult
from fusion.tracking.tracker import Tracker
from tests.fusion.synthetic import PERIOD_NS, TRIANGLE, WIDE, Arena, line

LARGE = msgspec.structs.replace(WIDE, diameter_m=0.2)
ARENA = Arena(
    {"a": TRIANGLE, "b": LARGE}, {"a": line((0.4, 0.1, 0.2)), "b": line((-0.4, 0.2, 0.3))}, sigma_px=0.05
)


def scaled(robot: Robot, factor: float) -> Robot:
    return msgspec.structs.replace(robot, diameter_m=factor * robot.diameter_m)


def tracked(arena: Arena, robots: dict[str, Robot], n: int) -> tuple[Tracker, list[TrackingResult]]:
    """The tracker of declared robots, and its results."""
    tracker, synchronizer = Tracker(arena.cameras, robots), FrameSynchronizer(PERIOD_NS)
    closed = []
    for frame in arena.frames(n):
        synchronizer.add(frame)
        closed += synchronizer.take(frame.t_ns)
    return tracker, [tracker.track(frame_set) for frame_set in (*closed, *synchronizer.finish())]


def test_markers_of_other_sizes_are_reported_beside_declared_robots():
    """At their places, with their size and normal; the declared robot is tracked as without them."""
    _, results = tracked(ARENA, {"a": TRIANGLE}, 20)
    assert [pose.state for pose in results[-1].poses] == ["tracked"]
    markers = results[-1].markers
    rows = markers.unlabeled()
    R, p = ARENA.truth("b", results[-1].t_ns)
    off = np.linalg.norm(markers.positions()[rows][:, None] - (p + LARGE.points @ R.T), axis=2)
    assert sorted(off.argmin(1)) == [0, 1, 2]
    assert off.min(1).max() < 5e-3
    assert markers.diameters()[rows] == pytest.approx([LARGE.diameter_m] * 3, rel=0.05)
    assert (markers.normals()[rows] @ R[:, 2] > 0.98).all()


def test_a_robot_with_another_size_has_that_as_its_reason():
    tracker, _ = tracked(ARENA, {"a": TRIANGLE, "b": scaled(LARGE, 0.5)}, 10)
    reason = tracker.not_acquired()["b"]
    assert reason.startswith("declared with discs of 100 mm, but unlabeled ones measure ")
    assert abs(float(reason.split()[-2]) - 200) < 10


@pytest.mark.parametrize(("factor", "is_found"), [(0.92, True), (1.0, False), (1.09, True)])
def test_a_slightly_wrong_size_is_measured(factor: float, is_found: bool):
    """It is tracked, but ranges from single views are wrong: a print that was scaled to fit its page."""
    tracker, results = tracked(ARENA, {"a": scaled(TRIANGLE, factor), "b": LARGE}, 96)
    assert {pose.robot: pose.state for pose in results[-1].poses} == {"a": "tracked", "b": "tracked"}
    found = tracker.sizes.misfits()
    assert found == ({"a": pytest.approx(TRIANGLE.diameter_m, rel=0.02)} if is_found else {})
