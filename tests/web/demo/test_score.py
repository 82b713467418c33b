# SPDX-License-Identifier: BSD-3-Clause
"""The demo passes with correct poses, and fails with wrong, missing or interrupted ones."""

import numpy as np
import pytest

from camera_node.geometry.pose import rotation_from_vector, wxyz_from_rotation
from fusion.protocol.pose_messages import RobotPose, TrackingState
from web.demo.score import PoseScore, describe_overload, longest_gap_s, summarize

SECOND = 10**9
ROBOTS = {"rover": 3, "puck": 1}


def true_pose(robot: str, t_ns: int) -> np.ndarray | None:
    """Both robots drive along x at 1 m/s and turn by 1 rad per metre; neither exists before t = 0."""
    if t_ns < 0:
        return None
    T = np.eye(4)
    T[:3, :3] = rotation_from_vector([0.0, 0.0, 1e-9 * t_ns])
    T[0, 3] = 1e-9 * t_ns
    return T


def pose_of(robot: str, t_ns: int, T: np.ndarray, state: TrackingState = "tracked") -> RobotPose:
    return RobotPose(
        robot=robot,
        t_ns=t_ns,
        state=state,
        position=tuple(T[:3, 3].tolist()),
        quaternion_wxyz=tuple(wxyz_from_rotation(T[:3, :3]).tolist()),
        velocity=(0.0, 0.0, 0.0),
        angular_velocity=(0.0, 0.0, 0.0),
        covariance=bytes(576),
        n_markers=3,
    )


def score_of(offset_m: float, absent_s: tuple[float, float] = (0.0, 0.0)) -> PoseScore:
    """Two seconds of poses with an error of `offset_m` in z; the rover coasts during `absent_s`."""
    score = PoseScore(true_pose, ROBOTS)
    for t_ns in range(0, 2 * SECOND, SECOND // 50):
        for robot in ROBOTS:
            T = np.array(true_pose(robot, t_ns))
            T[2, 3] += offset_m
            coasts = robot == "rover" and absent_s[0] <= 1e-9 * t_ns < absent_s[1]
            score.add(pose_of(robot, t_ns, T, "coasting" if coasts else "tracked"))
    return score


def faults_of(score: PoseScore) -> list[str]:
    return [fault for result in score.results(0, 2 * SECOND) for fault in result.faults()]


def test_correct_poses_pass():
    """Exact poses have only floating-point errors."""
    score = score_of(0.0)
    assert faults_of(score) == []
    rover, puck = score.results(0, 2 * SECOND)
    assert rover.max_mm < 1e-6
    assert rover.rotation_deg < 1e-5
    assert rover.tracked == 1.0
    assert np.isnan(puck.rotation_deg), "the heading of one marker is unobservable"
    assert score.all_tracked()


def test_wrong_poses_fail():
    """4 mm are within the limit of 5 mm, 6 mm are not, and the message has the error."""
    assert faults_of(score_of(0.004)) == []
    score = score_of(0.006)
    assert faults_of(score)[0] == "rover: position error 6.0 mm RMS (limit 5 mm)"
    assert score.recent_mm("puck") == pytest.approx(6.0)


def test_a_missing_robot_fails():
    """A robot without poses, and one without a tracked pose."""
    score = PoseScore(true_pose, ROBOTS)
    score.add(pose_of("rover", SECOND, np.eye(4), "lost"))
    assert faults_of(score) == ["rover was never tracked", "puck was never tracked"]
    assert not score.all_tracked()
    (rover, _) = score.results(0, 2 * SECOND)
    assert rover.faults("ambiguous with cart") == ["rover was never tracked: ambiguous with cart"]


def test_a_gap_fails():
    """A gap of 0.4 s passes, one of 0.6 s does not; the interval of the poses, 20 ms, adds to it."""
    assert faults_of(score_of(0.0, (1.0, 1.4))) == []
    (fault,) = faults_of(score_of(0.0, (1.0, 1.6)))
    assert fault == "rover: not tracked for 0.62 s (limit 0.5 s)"


def test_a_gap_at_the_start_or_the_end_fails():
    assert faults_of(score_of(0.0, (1.3, 9.0))) == ["rover: not tracked for 0.72 s (limit 0.5 s)"]
    assert faults_of(score_of(0.0, (0.0, 0.7))) == ["rover: not tracked for 0.70 s (limit 0.5 s)"]


def test_poses_without_a_true_pose_do_not_count():
    """Poses before the robots exist, before the score starts, and of undeclared robots."""
    score = PoseScore(true_pose, ROBOTS)
    score.add(pose_of("rover", -SECOND, np.eye(4)))
    score.add(pose_of("stranger", SECOND, np.eye(4)))
    late = PoseScore(true_pose, ROBOTS, start_ns=3 * SECOND)
    late.add(pose_of("rover", SECOND, np.eye(4)))
    assert late.errors["rover"].n_poses == 0
    assert not score.all_tracked()


def test_the_longest_gap():
    """In any order of the poses, with both ends."""
    assert longest_gap_s([3 * SECOND, SECOND], 0, 4 * SECOND) == 2.0
    assert longest_gap_s([], 0, 4 * SECOND) == 4.0
    assert longest_gap_s([9 * SECOND], 0, 4 * SECOND) == 4.0


def test_the_summary_has_one_line_per_robot():
    """And one on the latency if it is known."""
    results = score_of(0.0).results(0, 2 * SECOND)
    lines = summarize(results, [5.0] * 99 + [50.0])
    assert [line.split(":")[0] for line in lines] == ["rover", "puck", "latency"]
    assert "5.0 ms p50" in lines[-1]
    assert len(summarize(results, [])) == 2


def test_a_machine_that_is_too_slow_is_named():
    """A verdict on a machine that drops frames says little about the software."""
    usual = {"north": 20.0, "east": 30.0}
    assert describe_overload({"north": 18.5, "east": 27.5}, usual) == []
    (line,) = describe_overload({"north": 11.0, "east": 16.0}, usual)
    assert "camera east sent 16.0 of 30.0 frames/s" in line
