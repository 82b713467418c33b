# SPDX-License-Identifier: BSD-3-Clause
"""Properties of tracking: exact without noise, correct covariances, no identity swaps, no guesses."""

from dataclasses import replace

import numpy as np
import pytest

from fusion.model.frames import CalibratedFrame
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import Tracker
from tests.fusion.synthetic import PERIOD_NS, SINGLE, TRIANGLE, WIDE, Arena, line, measured, precise
from tests.fusion.tracks import errors, poses_of, track

MOVING = line((0.2, -0.3, 0.4), velocity=(0.9, 0.6, 0.1), turn=(0.2, 0.1, 1.0), tilt=(0.1, -0.2, 0.4))


@pytest.mark.parametrize("motion", [line((0.3, 0.1, 0.2), tilt=(0.2, 0.1, 0.5)), MOVING])
def test_exact_without_noise_with_free_running_cameras(run_arena, motion):
    """The model includes uniform motion. The remaining errors come from linearization and from the affine lens over a
    disc: the centre of a distorted ellipse is 1e-3 px off."""
    arena = Arena({"a": TRIANGLE}, {"a": motion})
    _, poses = run_arena(replace(arena, cameras=precise(arena.cameras)))
    late = poses("a")[10:]
    error = errors(arena, late)
    assert len(late) >= 19
    assert np.abs(error[:, 3:]).max() < 5e-5
    assert np.abs(error[:, :3]).max() < 5e-4
    _, p = arena.truth("a", late[-1].t_ns)
    velocity = (arena.truth("a", late[-1].t_ns + 10**6)[1] - p) / 1e-3
    assert np.abs(late[-1].velocity - velocity).max() < 0.01


def test_free_running_cameras_are_as_accurate_as_synchronized_ones(run_arena):
    """With the same noise, the accuracy does not depend on the phases of the cameras."""
    rms = []
    for phases in ((0.0, 0.0, 0.0, 0.0), (0.0, 0.27, -0.41, 0.38)):
        arena = Arena({"a": TRIANGLE}, {"a": MOVING}, sigma_px=0.05, phases=phases)
        _, poses = run_arena(arena, 40)
        rms.append(np.sqrt((errors(arena, poses("a")[5:])[:, 3:] ** 2).sum(1).mean()))
    assert rms[1] < 2 * rms[0]
    assert rms[1] < 1e-3


def test_published_covariance_matches_the_errors():
    """Squared Mahalanobis errors of the last of several poses follow chi-square with 6 degrees of freedom: the mean of
    60 runs, each of a robot that was measured as well as is claimed, is 6 +- 4 sqrt(12 / 60)."""
    squares, positions = [], []
    for seed in range(60):
        arena = Arena({"a": TRIANGLE}, {"a": MOVING}, sigma_px=0.1, seed=seed)
        robots = {"a": measured(TRIANGLE, np.random.default_rng(seed))}
        given = replace(arena, cameras=precise(arena.cameras), robots=robots)
        pose = track(given, arena.frames(5))[-2].poses[0]
        e, P = errors(arena, [pose])[0], pose.covariance_matrix
        squares.append(e @ np.linalg.solve(P[:6, :6], e))
        positions.append(e[3:] @ np.linalg.solve(P[3:6, 3:6], e[3:]))
    assert np.mean(squares) == pytest.approx(6, abs=4 * np.sqrt(12 / 60))
    assert np.mean(positions) == pytest.approx(3, abs=4 * np.sqrt(6 / 60))


def test_several_robots_are_acquired_at_once_among_false_detections(run_arena):
    arena = Arena(
        {"a": TRIANGLE, "b": WIDE},
        {"a": line((-0.5, 0.3, 0.15), (0.3, 0, 0)), "b": line((0.5, -0.2, 0.6), (0, 0.3, 0))},
        sigma_px=0.05,
        distractors=4,
    )
    results, poses = run_arena(arena)
    for robot in "ab":
        assert len(poses(robot)) >= len(results) - 2
        assert np.abs(errors(arena, poses(robot)[3:])[:, 3:]).max() < 3e-3


def test_crossing_robots_are_not_swapped(run_arena):
    """They pass each other at a distance of 0.3 m, so their markers mix in some images."""
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


def test_a_hidden_robot_coasts_is_lost_and_is_acquired_again(run_arena):
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


@pytest.mark.ci
@pytest.mark.parametrize("cameras", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_covariance_matches_the_errors_from_the_first_pose_on(cameras):
    """The velocity of a robot that was just acquired is unknown, so free-running cameras determine its position to
    millimetres only. Chi-square with 6 degrees of freedom: mean 6 +- 4 sqrt(12 / 20)."""
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
        poses = [
            pose
            for result in track(replace(arena, cameras=precise(arena.cameras)), frames)
            for pose in result.poses
        ]
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


def test_two_of_three_markers_acquire_no_robot(run_arena):
    arena = Arena(
        {"a": TRIANGLE}, {"a": line((0, 0, 0.2))}, sigma_px=0.05, hidden=lambda robot, marker, t: marker == 1
    )
    results, poses = run_arena(arena, 10)
    assert poses("a") == []
    assert (results[5].markers.robot_index() == -1).sum() == 2


def test_a_single_marker_has_a_position_and_a_normal_and_a_large_variance_of_its_rotation(run_arena):
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


@pytest.mark.ci
@pytest.mark.parametrize("speed", [pytest.param(0.0, marks=pytest.mark.slow), 0.8])
def test_an_unlabeled_marker_has_position_velocity_and_normal(speed: float):
    """Squared Mahalanobis errors of position and velocity in the last of ten frame sets follow chi-square with 3
    degrees of freedom: the mean of 30 runs is 3 +- 4 sqrt(6 / 30). The normal from four views is within 12 degrees."""
    squares = []
    for seed in range(30):
        motion = line((-0.1, 0.1, 0.3), velocity=(speed, -speed / 2, 0.1 * speed), tilt=(0.2, 0.1, 0.0))
        arena = Arena({"x": SINGLE}, {"x": motion}, sigma_px=0.1, seed=seed)
        tracker, synchronizer = (
            Tracker(precise(arena.cameras), {"other": TRIANGLE}),
            FrameSynchronizer(33_333_333),
        )
        for frame in arena.frames(10):
            synchronizer.add(frame)
        *_, last = (tracker.track(frame_set) for frame_set in synchronizer.finish()[:-1])
        R, p = motion(arena.seconds(last.t_ns))
        assert last.markers.robot_index().tolist() == [-1]
        assert last.markers.normals()[0] @ R[:, 2] > np.cos(np.radians(12))
        P = np.frombuffer(last.markers.covariance, "<f4").reshape(3, 3).astype(float)
        e = last.markers.positions()[0] - p
        off = last.markers.velocities()[0] - np.multiply((1, -0.5, 0.1), speed)
        V = tracker.unlabeled._tracks.states.P[0, 9:, 9:]
        squares.append([e @ np.linalg.solve(P, e), off @ np.linalg.solve(V, off)])
    assert np.mean(squares, 0) == pytest.approx([3, 3], abs=4 * np.sqrt(6 / 30))


def test_indistinguishable_single_markers_stay_unlabeled(run_arena):
    arena = Arena({"c": SINGLE, "d": SINGLE}, {"c": line((0.3, 0, 0.2)), "d": line((-0.3, 0, 0.2))})
    results, poses = run_arena(arena, 8)
    assert poses("c") == poses("d") == []
    assert len(results[4].markers) == 2


def test_a_known_start_distinguishes_single_markers(run_arena):
    robots = {
        "c": SINGLE.__class__(diameter_m=0.12, start_m=(0.3, 0.0, 0.2)),
        "d": SINGLE.__class__(diameter_m=0.12, start_m=(-0.3, 0.0, 0.2)),
    }
    arena = Arena(robots, {"c": line((0.35, 0, 0.2)), "d": line((-0.3, 0.1, 0.2))}, sigma_px=0.05)
    _, poses = run_arena(arena, 8)
    assert np.abs(errors(arena, poses("c") + poses("d"))[:, 3:]).max() < 3e-3


def test_detections_without_axes_are_enough(run_arena):
    """As from observations.csv: geometry alone associates the views."""
    arena = Arena({"a": TRIANGLE}, {"a": MOVING}, sigma_px=0.05)
    frames = []
    for frame in arena.frames(20):
        roundels = frame.roundels
        bare = type(roundels).from_points(roundels.uv, 0.3)
        frames.append(CalibratedFrame.measure(frame.camera, frame.t_ns, bare, arena.cameras[frame.camera]))
    results = track(arena, frames)
    tracked = [pose for result in results for pose in result.poses]
    assert len(tracked) >= 17
    assert np.abs(errors(arena, tracked[3:])[:, 3:]).max() < 5e-3


def test_late_frames_are_used_and_the_covariance_covers_them():
    """cam1 is 100 ms late, so its frames miss their frame sets. The robot moves in a circle at 0.5 m/s (1 m/s^2). The
    inflated noise of late detections covers this motion: the mean squared error of 12 runs is below
    6 + 4 sqrt(12 / 12), and cam1 is used."""
    squares = []
    for seed in range(12):
        arena = Arena({"a": TRIANGLE}, {"a": circle}, sigma_px=0.1, seed=seed)
        tracker, closed = Tracker(precise(arena.cameras), arena.robots), []
        synchronizer = FrameSynchronizer(33_333_333, 60_000_000)
        arrivals = [(f.t_ns + (100_000_000 if f.camera == "cam1" else 0), f) for f in arena.frames(14)]
        for now_ns, frame in sorted(arrivals, key=lambda arrival: arrival[0]):
            synchronizer.add(frame)
            closed += [tracker.track(frame_set) for frame_set in synchronizer.take(now_ns)]
        late = [result for result in closed if result.poses and result.cameras["cam1"].used]
        pose = late[-1].poses[0]
        e, P = errors(arena, [pose])[0], pose.covariance_matrix[:6, :6]
        squares.append(e @ np.linalg.solve(P, e))
    assert np.mean(squares) < 6 + 4 * np.sqrt(12 / 12)


def circle(t: float) -> tuple[np.ndarray, np.ndarray]:
    """R and p on a circle of 0.25 m at 0.5 m/s."""
    return np.eye(3), np.array([0.25 * np.cos(2 * t), 0.25 * np.sin(2 * t), 0.2])


def test_the_noise_of_stamps_is_noise_along_the_motion():
    """Stamps with uniform errors of up to 10 ms displace detections of a robot at 0.9 m/s by up to 9 mm, 2 px.

    Squared errors by covariance have the mean 1 at most: velocities may change suddenly, so their covariance is wide,
    and on a straight line they do not. With exact times assumed the mean is far above. The first 16 frame sets are
    exact: a rig that errors of stamps contradict from the start claims less.
    """
    arena = Arena({"a": TRIANGLE}, {"a": line((-0.9, 0.2, 0.2), (0.9, -0.2, 0.0))}, sigma_px=0.05)
    random, bound_s = np.random.default_rng(5), 0.01
    error_ns = np.round(random.uniform(-bound_s, bound_s, 240) * 1e9).astype(int).tolist()
    error_ns[:64] = [0] * 64
    honesty = []
    for sigma_s in (bound_s / np.sqrt(3), 0.0):
        frames = [
            replace(frame, t_ns=frame.t_ns + error, clock_sigma_s=sigma_s)
            for frame, error in zip(arena.frames(60), error_ns, strict=True)
        ]
        poses = [pose for pose in poses_of(track(arena, frames), "a")[20:] if pose.state == "tracked"]
        assert len(poses) > 30
        P = np.array([np.frombuffer(p.covariance, "<f4").reshape(12, 12)[3:6, 3:6] for p in poses], float)
        e = errors(arena, poses)[:, 3:]
        honesty.append(float(np.mean(np.einsum("ni,ni->n", e, np.linalg.solve(P, e[..., None])[..., 0])) / 3))
    assert 0.1 < honesty[0] < 1.0 + 4 * np.sqrt(2 / 90)
    assert honesty[1] > 10.0


def test_an_arena_without_robots_has_markers():
    """From which its first robot is defined."""
    arena = Arena({"a": TRIANGLE}, {"a": line((0.1, 0.2, 0.3))}, sigma_px=0.05)
    tracker, synchronizer = Tracker(arena.cameras, {}), FrameSynchronizer(PERIOD_NS)
    for frame in arena.frames(10):
        synchronizer.add(frame)
    *_, result = [tracker.track(frame_set) for frame_set in synchronizer.finish()]
    assert not result.poses
    n_seen_by_several = np.isfinite(result.markers.positions()).all(1).sum()
    assert n_seen_by_several == len(TRIANGLE.markers)
