# SPDX-License-Identifier: BSD-3-Clause
"""Properties of tracking: exact without noise, honest with it, nobody swapped, nothing guessed."""

import numpy as np
import pytest

from fusion.model.frames import CalibratedFrame
from fusion.model.limits import Limits
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import Tracker
from tests.fusion.conftest import errors, fuse
from tests.fusion.synthetic import SINGLE, TRIANGLE, WIDE, Arena, line

TIGHT = Limits(sigma_floor_px=1e-3)
MOVING = line((0.2, -0.3, 0.4), velocity=(0.9, 0.6, 0.1), turn=(0.2, 0.1, 1.0), tilt=(0.1, -0.2, 0.4))


@pytest.mark.parametrize("motion", [line((0.3, 0.1, 0.2), tilt=(0.2, 0.1, 0.5)), MOVING])
def test_exact_without_noise_though_cameras_run_free(run_arena, motion):
    """Uniform motion is in the model, so what remains after the start is linearisation and the lens over a disc:
    a distorted ellipse's centre is 1e-3 px off."""
    arena = Arena({"a": TRIANGLE}, {"a": motion})
    _, poses = run_arena(arena, limits=TIGHT)
    late = poses("a")[10:]
    error = errors(arena, late)
    assert len(late) >= 19
    assert np.abs(error[:, 3:]).max() < 5e-5
    assert np.abs(error[:, :3]).max() < 5e-4
    _, p = arena.truth("a", late[-1].t_ns)
    velocity = (arena.truth("a", late[-1].t_ns + 10**6)[1] - p) / 1e-3
    assert np.abs(late[-1].velocity - velocity).max() < 0.01


def test_free_running_cameras_cost_nothing(run_arena):
    """With the same noise, the accuracy of cameras that fire apart is that of cameras that fire together."""
    rms = []
    for phases in ((0.0, 0.0, 0.0, 0.0), (0.0, 0.27, -0.41, 0.38)):
        arena = Arena({"a": TRIANGLE}, {"a": MOVING}, sigma_px=0.05, phases=phases)
        _, poses = run_arena(arena, 40)
        rms.append(np.sqrt((errors(arena, poses("a")[5:])[:, 3:] ** 2).sum(1).mean()))
    assert rms[1] < 2 * rms[0]
    assert rms[1] < 1e-3


def test_published_covariance_is_honest():
    """Squared Mahalanobis errors of the last of several instants follow chi-square with 6 degrees: the mean of 60
    runs is 6 +- 4 sqrt(12 / 60)."""
    squares, positions = [], []
    for seed in range(60):
        arena = Arena({"a": TRIANGLE}, {"a": MOVING}, sigma_px=0.1, seed=seed)
        pose = fuse(arena, arena.frames(5), Limits(sigma_floor_px=1e-3))[-2].poses[0]
        e, P = errors(arena, [pose])[0], pose.covariance_matrix
        squares.append(e @ np.linalg.solve(P[:6, :6], e))
        positions.append(e[3:] @ np.linalg.solve(P[3:6, 3:6], e[3:]))
    assert np.mean(squares) == pytest.approx(6, abs=4 * np.sqrt(12 / 60))
    assert np.mean(positions) == pytest.approx(3, abs=4 * np.sqrt(6 / 60))


def test_several_robots_are_found_at_once_among_false_detections(run_arena):
    arena = Arena(
        {"a": TRIANGLE, "b": WIDE},
        {"a": line((-0.5, 0.3, 0.15), (0.3, 0, 0)), "b": line((0.5, -0.2, 0.6), (0, 0.3, 0))},
        sigma_px=0.05,
        distractors=4,
    )
    fused, poses = run_arena(arena)
    for robot in "ab":
        assert len(poses(robot)) >= len(fused) - 2
        assert np.abs(errors(arena, poses(robot)[3:])[:, 3:]).max() < 3e-3


def test_crossing_robots_are_not_swapped(run_arena):
    """They pass over each other 0.3 m apart, so that each hides among the other's markers in some images."""
    arena = Arena(
        {"a": TRIANGLE, "b": WIDE, "c": SINGLE},
        {
            "a": line((-0.6, 0.0, 0.15), (1.2, 0, 0)),
            "b": line((0.6, 0.05, 0.45), (-1.2, 0, 0)),
            "c": line((-0.1, 0.6, 0.8), (0, -1.2, 0)),
        },
        sigma_px=0.05,
    )
    _, poses = run_arena(arena)
    for robot in "abc":
        assert len(poses(robot)) >= 26
        assert np.abs(errors(arena, poses(robot)[3:])[:, 3:]).max() < 5e-3


def test_a_hidden_robot_coasts_is_lost_and_comes_back(run_arena):
    arena = Arena(
        {"a": TRIANGLE},
        {"a": line((0.0, 0.0, 0.2), (0.2, 0, 0))},
        sigma_px=0.05,
        hidden=lambda robot, marker, t: 0.5 < t < 1.2,
    )
    _, poses = run_arena(arena, 60)
    states = [pose.state for pose in poses("a")]
    order = [state for k, state in enumerate(states) if k == 0 or states[k - 1] != state]
    assert order == ["tracked", "coasting", "lost", "tracked"]
    lost = [p for p in poses("a") if p.state == "lost"]
    grown = [np.trace(p.covariance_matrix[3:6, 3:6]) for p in lost]
    assert (np.diff(grown) > 0).all()
    assert np.abs(errors(arena, poses("a")[-5:])[:, 3:]).max() < 3e-3


@pytest.mark.parametrize("cameras", [2, 4])
def test_covariance_is_honest_from_the_first_instant_on(cameras):
    """Of a robot that was just found, and of one found again: its speed is not known, so that free-running cameras
    know its place to millimetres only, and say so. Chi-square with 6 degrees, mean 6 +- 4 sqrt(12 / 20)."""
    squares = []
    for seed in range(10):
        arena = Arena(
            {"a": TRIANGLE},
            {"a": MOVING},
            sigma_px=0.1,
            seed=seed,
            hidden=lambda robot, marker, t: 0.2 < t < 0.6,
        )
        frames = [f for f in arena.frames(26) if cameras == 4 or f.camera in ("cam0", "cam2")]
        poses = [pose for fused in fuse(arena, frames, TIGHT) for pose in fused.poses]
        before = ["lost", *(pose.state for pose in poses)]
        found = [p for was, p in zip(before, poses, strict=False) if was == "lost" != p.state]
        assert len(found) == 2
        for pose in found:
            e, P = errors(arena, [pose])[0], pose.covariance_matrix[:6, :6]
            squares.append(e @ np.linalg.solve(P, e))
    assert np.mean(squares) == pytest.approx(6, abs=4 * np.sqrt(12 / 20))


def test_two_visible_markers_keep_a_constellation_tracked(run_arena):
    arena = Arena(
        {"a": TRIANGLE},
        {"a": line((0.0, 0.0, 0.2), (0.3, 0.1, 0), (0, 0, 0.5))},
        sigma_px=0.05,
        hidden=lambda robot, marker, t: marker == 1 and t > 0.4,
    )
    _, poses = run_arena(arena, 40)
    late = poses("a")[-10:]
    assert {(pose.state, pose.n_markers) for pose in late} == {("tracked", 2)}
    assert np.abs(errors(arena, late)[:, 3:]).max() < 5e-3


def test_two_of_three_markers_find_no_robot(run_arena):
    arena = Arena(
        {"a": TRIANGLE}, {"a": line((0, 0, 0.2))}, sigma_px=0.05, hidden=lambda robot, marker, t: marker == 1
    )
    fused, poses = run_arena(arena, 10)
    assert poses("a") == []
    assert (fused[5].markers.robot_index() == -1).sum() == 2


def test_a_single_marker_has_a_place_and_a_normal_and_says_that_its_turn_is_unknown(run_arena):
    arena = Arena(
        {"c": SINGLE}, {"c": line((0.1, 0.2, 0.3), (0.5, 0, 0), tilt=(0.35, -0.1, 0))}, sigma_px=0.03
    )
    _, poses = run_arena(arena)
    late = poses("c")[10:]
    assert np.abs(errors(arena, late)[:, 3:]).max() < 3e-3
    from camera_node.geometry.pose import rotation_from_wxyz

    for pose in late:
        true, got = arena.truth("c", pose.t_ns)[0][:, 2], rotation_from_wxyz(pose.quaternion_wxyz)[:, 2]
        assert np.degrees(np.arccos(np.clip(true @ got, -1, 1))) < 6
        assert pose.covariance_matrix[2, 2] > 9


@pytest.mark.parametrize("speed", [0.0, 0.8])
def test_a_marker_of_nobody_has_position_velocity_and_normal(speed: float):
    """Squared Mahalanobis errors of place and speed of the last of ten instants follow chi-square with 3 degrees
    each, the mean of 30 runs being 3 +- 4 sqrt(6 / 30); the normal, from four views, is within its 12 degrees."""
    squares = []
    for seed in range(30):
        motion = line((-0.1, 0.1, 0.3), velocity=(speed, -speed / 2, 0.1 * speed), tilt=(0.2, 0.1, 0.0))
        arena = Arena({"x": SINGLE}, {"x": motion}, sigma_px=0.1, seed=seed)
        tracker, instants = Tracker(arena.cameras, {"other": TRIANGLE}, TIGHT), FrameSynchronizer(33_333_333)
        for frame in arena.frames(10):
            instants.add(frame)
        *_, last = (tracker.track(instant) for instant in instants.finish()[:-1])
        R, p = motion(arena.seconds(last.t_ns))
        assert last.markers.robot_index().tolist() == [-1]
        assert last.markers.normals()[0] @ R[:, 2] > np.cos(np.radians(12))
        P = np.frombuffer(last.markers.covariance, "<f4").reshape(3, 3).astype(float)
        e = last.markers.positions()[0] - p
        off = last.markers.velocities()[0] - np.multiply((1, -0.5, 0.1), speed)
        V = tracker.unlabeled._tracks.states.P[0, 9:, 9:]
        squares.append([e @ np.linalg.solve(P, e), off @ np.linalg.solve(V, off)])
    assert np.mean(squares, 0) == pytest.approx([3, 3], abs=4 * np.sqrt(6 / 30))


def test_single_markers_that_nothing_tells_apart_stay_unlabelled(run_arena):
    arena = Arena({"c": SINGLE, "d": SINGLE}, {"c": line((0.3, 0, 0.2)), "d": line((-0.3, 0, 0.2))})
    fused, poses = run_arena(arena, 8)
    assert poses("c") == poses("d") == []
    assert len(fused[4].markers) == 2


def test_a_known_start_tells_single_markers_apart(run_arena):
    robots = {
        "c": SINGLE.__class__(diameter_m=0.12, start_m=(0.3, 0.0, 0.2)),
        "d": SINGLE.__class__(diameter_m=0.12, start_m=(-0.3, 0.0, 0.2)),
    }
    arena = Arena(robots, {"c": line((0.35, 0, 0.2)), "d": line((-0.3, 0.1, 0.2))}, sigma_px=0.05)
    _, poses = run_arena(arena, 8)
    assert np.abs(errors(arena, poses("c") + poses("d"))[:, 3:]).max() < 3e-3


def test_detections_without_axes_are_enough(run_arena):
    """As out of observations.csv: geometry alone matches the views."""
    arena = Arena({"a": TRIANGLE}, {"a": MOVING}, sigma_px=0.05)
    frames = []
    for frame in arena.frames(20):
        roundels = frame.roundels
        bare = type(roundels).from_points(roundels.uv, 0.3)
        frames.append(CalibratedFrame.measure(frame.camera, frame.t_ns, bare, arena.cameras[frame.camera]))
    fused = fuse(arena, frames)
    tracked = [pose for instant in fused for pose in instant.poses]
    assert len(tracked) >= 17
    assert np.abs(errors(arena, tracked[3:])[:, 3:]).max() < 5e-3


def test_late_frames_are_used_and_leave_the_covariance_honest():
    """cam1 is 100 ms behind, so its frames miss their instants. The robot turns a circle at 0.5 m/s (1 m/s^2): what it
    did meanwhile is within what a late detection's noise grew by, so the mean squared error of 12 runs is 6 at the
    most + 4 sqrt(12 / 12), and cam1 is used."""
    squares = []
    for seed in range(12):
        arena = Arena({"a": TRIANGLE}, {"a": circle}, sigma_px=0.1, seed=seed)
        tracker, closed = Tracker(arena.cameras, arena.robots, TIGHT), []
        instants = FrameSynchronizer(33_333_333, 60_000_000)
        arrivals = [(f.t_ns + (100_000_000 if f.camera == "cam1" else 0), f) for f in arena.frames(14)]
        for now_ns, frame in sorted(arrivals, key=lambda arrival: arrival[0]):
            instants.add(frame)
            closed += [tracker.track(instant) for instant in instants.take(now_ns)]
        late = [fused for fused in closed if fused.poses and fused.cameras["cam1"].used]
        pose = late[-1].poses[0]
        e, P = errors(arena, [pose])[0], pose.covariance_matrix[:6, :6]
        squares.append(e @ np.linalg.solve(P, e))
    assert np.mean(squares) < 6 + 4 * np.sqrt(12 / 12)


def circle(t: float) -> tuple[np.ndarray, np.ndarray]:
    """R and p on a circle of 0.25 m at 0.5 m/s."""
    return np.eye(3), np.array([0.25 * np.cos(2 * t), 0.25 * np.sin(2 * t), 0.2])
