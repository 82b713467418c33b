# SPDX-License-Identifier: BSD-3-Clause
"""Acquisition of robots with a single marker beside markers of the same size, and why a robot is not acquired."""

import msgspec
import numpy as np
import pytest

from fusion.model.robots import Robot
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import PAUSED, Tracker
from tests.fusion.synthetic import PERIOD_NS, SINGLE, TRIANGLE, WIDE, Arena, line

STILL = line((-0.5, 0.1, 0.2))
DRIVING = line((-0.5, 0.1, 0.2), (0.3, 0.1, 0.0))
OTHER = line((0.4, 0.2, 0.3), (-0.2, 0.15, 0.0), tilt=(0.05, -0.04, 0.7))


def run(
    arena: Arena, robots: dict[str, Robot], n: int, is_wand_recorded: bool = False
) -> tuple[Tracker, int]:
    """A tracker of some of the arena's robots after n frame sets, and in how many of these a pose was wrong."""
    tracker, synchronizer, n_wrong = Tracker(arena.cameras, robots), FrameSynchronizer(PERIOD_NS), 0
    tracker.acquires_none = is_wand_recorded
    for frame in arena.frames(n):
        synchronizer.add(frame)
    for frame_set in synchronizer.finish():
        for pose in tracker.track(frame_set).poses:
            is_near = np.linalg.norm(pose.position - arena.truth(pose.robot, pose.t_ns)[1]) < 0.05
            n_wrong += pose.state == "tracked" and not is_near
    return tracker, n_wrong


def beside(motion, hidden=lambda robot, marker, t: False) -> Arena:
    """A single-marker robot `s`, and an undefined one with three markers of the same size, as a wand has."""
    return Arena({"s": SINGLE, "b": WIDE}, {"s": motion, "b": OTHER}, sigma_px=0.05, hidden=hidden)


def test_a_marker_that_moves_alone_is_the_single_marker_robot():
    """Of four markers of its size, three move together. All have moved by 0.05 m after 0.2 s."""
    tracker, n_wrong = run(beside(DRIVING), {"s": SINGLE}, 20)
    assert (tracker.table.status, n_wrong) == (["tracked"], 0)


def test_markers_that_move_together_leave_the_one_that_stands_still():
    tracker, n_wrong = run(beside(STILL), {"s": SINGLE}, 20)
    assert (tracker.table.status, n_wrong) == (["tracked"], 0)


def test_a_wand_is_no_single_marker_robot():
    """The robot is away. In the first two frame sets one of the wand's markers is seen, then all."""
    arena = beside(DRIVING, lambda robot, marker, t: robot == "s" or (marker > 0 and t < 0.06))
    tracker, n_wrong = run(arena, {"s": SINGLE}, 45)
    assert (tracker.table.status, n_wrong) == ([None], 0)
    assert tracker.not_acquired() == {
        "s": "the markers of its size near it move together: they belong to another body"
    }


def test_a_marker_of_a_wand_whose_others_are_hidden_is_no_single_marker_robot():
    """All three have moved by 0.2 m when two of them are hidden."""
    arena = beside(DRIVING, lambda robot, marker, t: robot == "s" or (marker > 0 and t > 0.9))
    tracker, n_wrong = run(arena, {"s": SINGLE}, 60)
    assert (tracker.table.status, n_wrong) == ([None], 0)


def test_a_robot_that_passes_another_marker_is_in_its_company_only_while_the_distance_stays_the_same():
    """It starts abeam of a marker that stands still: 0.09 m later their distance has changed by 0.01 m."""
    motions = {"s": line((0.0, 0.0, 0.2), (0.4, 0.0, 0.0)), "o": line((0.0, 0.4, 0.2))}
    arena = Arena({"s": SINGLE, "o": SINGLE}, motions, sigma_px=0.05)
    tracker, n_wrong = run(arena, {"s": SINGLE}, 30)
    assert (tracker.table.status, n_wrong) == (["tracked"], 0)


def test_no_robot_is_acquired_while_the_wand_is_recorded():
    tracker, _ = run(beside(DRIVING), {"s": SINGLE, "b": WIDE}, 10, is_wand_recorded=True)
    assert tracker.table.status == [None, None]
    assert tracker.not_acquired() == dict.fromkeys("sb", PAUSED)


@pytest.mark.parametrize(
    ("robots", "hidden", "reasons"),
    [
        (
            {"a": TRIANGLE},
            lambda robot, marker, t: marker == 0,
            {"a": "fewer than 3 of its 3 markers are seen by two cameras"},
        ),
        (
            {"s": SINGLE},
            lambda robot, marker, t: True,
            {"s": "no unlabeled marker of its size is seen by two cameras"},
        ),
        (
            {"s": msgspec.structs.replace(SINGLE, start_m=(0.0, 2.0, 0.0))},
            lambda robot, marker, t: False,
            {"s": "no marker of its size is near its start or its last position"},
        ),
    ],
)
def test_the_reason_is_reported(robots, hidden, reasons):
    motions = dict.fromkeys(robots, STILL)
    tracker, _ = run(Arena(robots, motions, sigma_px=0.05, hidden=hidden), robots, 5)
    assert tracker.not_acquired() == reasons


def test_several_markers_of_one_size_are_reported():
    arena = Arena({"s": SINGLE, "t": SINGLE}, {"s": STILL, "t": line((0.5, 0.1, 0.2))}, sigma_px=0.05)
    tracker, _ = run(arena, {"s": SINGLE}, 5)
    assert tracker.not_acquired() == {
        "s": "2 markers of its size may be it: move it alone, or give its start_m"
    }


def test_identical_constellations_name_each_other():
    """Both start_m are far away: nothing tells the robots apart."""

    def twin(x: float) -> Robot:
        return Robot(diameter_m=0.12, markers=TRIANGLE.markers, start_m=(x, 2.0, 0.0))

    robots = {"cart": twin(1.0), "twin": twin(-1.0)}
    arena = Arena({"cart": robots["cart"]}, {"cart": line((0.0, 0.0, 0.2))}, sigma_px=0.05)
    tracker, _ = run(arena, robots, 5)
    assert tracker.not_acquired() == {"cart": "ambiguous with twin", "twin": "ambiguous with cart"}
