# SPDX-License-Identifier: BSD-3-Clause
"""Three robots hold a formation by relative localization alone; their estimates and control by parts."""

import re
import subprocess
import sys

import numpy as np
import pytest

from camera_node.detection.roundels import LocatedRoundels
from formation.formation_control import BLIND_S, DISTANCE_M, Follower, Leader, RelativeEstimator, place_of
from formation.formation_robots import DIMMEST, STANDSTILL, RobotWorld, between, compose, light, moved, wrap
from formation.live_formation import SETTLED_S, FormationScore, start_world, wanted_distances
from tests.conftest import free_port
from tests.examples.lockstep import run_lockstep

FRAME_S = 1 / 30
TIGHT = np.full(3, 0.05)


def seen(*poses: np.ndarray, probability: float = 1.0, other_turn: float = 0.0) -> LocatedRoundels:
    """What a camera locates of robots at `poses` (3,) in its robot's frame, to a tenth of a millimetre.

    The second normal, with the rest of the probability, is turned by `other_turn`.
    """
    n = len(poses)
    x, y, heading = np.array(poses).T
    normals = [[-np.sin(h), np.zeros(n), np.cos(h)] for h in (heading, heading + other_turn)]
    return LocatedRoundels(
        position=np.stack([-y, np.zeros(n), x], axis=1),
        cov=np.tile(1e-8 * np.eye(3), (n, 1, 1)),
        normals=np.moveaxis(np.array(normals), (0, 1, 2), (1, 2, 0)),
        probability=np.tile([probability, 1 - probability], (n, 1)),
        normal_sigma=np.full((n, 2), 1e-3),
        axis_distance=np.hypot(x, y),
        id=np.full(n, -1, np.int32),
        track=np.arange(n, dtype=np.int32),
    )


@pytest.mark.ci
def test_three_robots_hold_their_distances_under_changing_light():
    """Rendered pictures, the detector, messages and control: no collision, and within 2 cm after 5 s."""
    *_, (_, score) = run_lockstep(SETTLED_S + 2.5, seed=4)
    assert set(score.errors_m) == set(wanted_distances())
    assert all(len(errors) >= 70 for errors in score.errors_m.values())
    assert score.travelled_m > 0.5, "the leader drives"
    assert score.faults() == []


def test_the_score_finds_collisions_and_wrong_distances():
    score = FormationScore()
    poses = {"leader": np.zeros(3), "left": place_of(1), "right": place_of(-1)}
    score.add(SETTLED_S, poses)
    assert score.largest_error_m < 1e-12
    score.add(SETTLED_S, poses | {"left": np.add(place_of(1), [0.03, 0.0, 0.0])})
    score.add(SETTLED_S, poses | {"right": np.array([0.1, 0.0, 0.0])})
    assert len(score.faults()) == 2


def test_the_light_changes_several_times_and_suddenly():
    """Between a third and all of it; the lamp is worth 30 %."""
    levels = np.array([light(t, 0.0) for t in np.arange(0, 60, FRAME_S)])
    assert levels.min() >= DIMMEST
    assert levels.max() > 2.5 * levels.min()
    assert np.abs(np.diff(levels)).max() > 0.25


def test_an_estimator_follows_a_moving_robot():
    """A robot on an arc, seen from one that moves, after 2 s: within 2 mm and 0.01 rad, and 0.02 m/s or rad/s."""
    own_twist, twist = np.array([0.1, -0.05, 0.2]), np.array([-0.2, 0.0, 0.15])
    own, other = np.zeros(3), np.array([1.2, 0.1, 2.7])
    estimator = RelativeEstimator(np.add(other, [0.1, -0.1, 0.1]), np.full(3, 0.3))
    t_s = 0.0
    for k in range(60):
        t_s = k * FRAME_S
        estimator.update(seen(between(own, other)), t_s, own)
        own, other = moved(own, own_twist, FRAME_S), moved(other, twist, FRAME_S)
    pose, velocity = estimator.predicted(t_s + FRAME_S, own)
    e = pose - between(own, other)
    assert np.abs(e[:2]).max() < 2e-3
    assert abs(wrap(e[2])) < 0.01
    assert np.abs(velocity - twist).max() < 0.02


def test_history_settles_which_normal_is_right():
    """One frame in which the wrong normal is the more probable one does not turn the robot around."""
    pose = np.array([1.2, 0.0, 2.7])
    estimator = RelativeEstimator(pose, TIGHT)
    for k in range(30):
        estimator.update(seen(pose, probability=0.9, other_turn=0.8), k * FRAME_S, np.zeros(3))
    estimator.update(seen(pose, probability=0.05, other_turn=0.8), 1.0, np.zeros(3))
    swapped = seen(np.add(pose, [0, 0, 0.8]), probability=0.95, other_turn=-0.8)
    estimator.update(swapped, 1.0 + FRAME_S, np.zeros(3))
    assert estimator.predicted(1.1, np.zeros(3))[0] == pytest.approx(pose, abs=5e-3)


def test_a_roundel_elsewhere_is_not_the_leader():
    estimator = RelativeEstimator(np.array([1.2, 0.0, 2.7]), TIGHT)
    estimator.update(seen(np.array([2.5, 0.8, 2.7])), 0.0, np.zeros(3))
    assert estimator.updated_s is None
    estimator.update(seen(np.array([2.5, 0.8, 2.7]), np.array([1.21, 0.0, 2.71])), 0.1, np.zeros(3))
    assert estimator.updated_s == 0.1


def test_a_blind_follower_stops():
    follower, rest = Follower(1), np.zeros(3)
    assert (follower.command(0.0, rest) == STANDSTILL).all()
    follower.see(seen(np.add(follower.wanted, [0.1, 0.0, 0.0])), 0.0, rest)
    assert follower.command(0.05, rest)[0] > 0.1, "it approaches"
    assert (follower.command(BLIND_S + 0.01, rest) == STANDSTILL).all()


def test_the_leader_waits_for_followers():
    """It drives while both are in place, and stops when one is out of place or not seen."""
    places = [place_of(side) for side in (1, -1)]
    far = compose(places[1], np.array([-0.3, 0.0, 0.0]))

    def speed_after(leader: Leader, last: np.ndarray | None, start_s: float) -> float:
        command = STANDSTILL
        for k in range(90):
            t_s = start_s + k * FRAME_S
            leader.see(seen(places[0], *([] if last is None else [last])), t_s, np.zeros(3))
            command = leader.command(t_s, np.zeros(3))
        return float(-command[0])

    for last in (far, None):
        leader = Leader()
        assert speed_after(leader, places[1], 0.0) > 0.1
        assert speed_after(leader, last, 3.0) == 0.0


def test_robots_reach_their_commanded_velocity_and_odometry_drifts():
    """After a second, ten time constants, within the slip (3 sigma); odometry within 5 % of the way."""
    world = RobotWorld({"a": np.array([0.0, 0.0, 0.5])}, seed=1)
    world.drive("a", np.array([0.3, 0.0, 0.0]), 0.0)
    world.advance(2.0)
    way = between(world.at("a", 1.0).pose, world.at("a", 2.0).pose)
    assert way[0] == pytest.approx(0.3, abs=0.03)
    start, end = world.at("a", 0.0), world.at("a", 2.0)
    drift = between(start.odometry, end.odometry) - between(start.pose, end.pose)
    assert 1e-5 < np.linalg.norm(drift[:2]) < 0.05
    assert world.at("a", 1.5).pose[0] < world.at("a", 1.6).pose[0]


def test_followers_start_near_their_places():
    world = start_world(seed=2)
    distance = np.linalg.norm(between(world.at("leader", 0.0).pose, world.at("left", 0.0).pose)[:2])
    assert 0.5 < distance < 2 * DISTANCE_M
    assert abs(distance - DISTANCE_M) > 1e-3


def demo(seconds: float) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "web.roundel.command", "demo", "--relative", "--headless"]
    command += ["--seconds", str(seconds), "--listen", f"tcp/127.0.0.1:{free_port()}"]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_the_live_demo_drives_the_robots():
    """Nodes publish, drives receive. It is ended before the distances count, and says so."""
    done = demo(3.0)
    assert done.returncode == 1, done.stderr
    assert "FAILED: it ended before 5 s" in done.stdout
    assert sum(int(rate) for rate in re.findall(r"; (\d+) of 30 frames/s", done.stdout)) > 0
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_the_live_demo_passes():
    done = demo(20.0)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "PASSED: no collision, and all distances within 2 cm" in done.stdout
