# SPDX-License-Identifier: BSD-3-Clause
"""The demo's verdict: right poses pass, wrong, missing and interrupted ones do not."""

import numpy as np
import pytest

from camera_node.geometry.pose import rotation_from_vector, wxyz_from_rotation
from fusion.protocol.messages import RobotPose, TrackingState
from web.score import Score, angle_deg, longest_gap_s, summarise

SECOND = 10**9
ROBOTS = {"rover": 3, "puck": 1}


def truth(robot: str, t_ns: int) -> np.ndarray | None:
    """Both drive along x at 1 m/s, turned by a rad per metre; neither is there before t = 0."""
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


def score_of(offset_m: float, absent_s: tuple[float, float] = (0.0, 0.0)) -> Score:
    """Two seconds of poses, off by `offset_m` in z; the rover coasts while it is absent."""
    score = Score(truth, ROBOTS)
    for t_ns in range(0, 2 * SECOND, SECOND // 50):
        for robot in ROBOTS:
            T = np.array(truth(robot, t_ns))
            T[2, 3] += offset_m
            away = robot == "rover" and absent_s[0] <= 1e-9 * t_ns < absent_s[1]
            score.add(pose_of(robot, t_ns, T, "coasting" if away else "tracked"))
    return score


def faults_of(score: Score) -> list[str]:
    return [fault for result in score.results(0, 2 * SECOND) for fault in result.faults()]


def test_right_poses_pass():
    """Exact poses have no error but that of floating point."""
    score = score_of(0.0)
    assert faults_of(score) == []
    rover, puck = score.results(0, 2 * SECOND)
    assert rover.max_mm < 1e-6
    assert rover.rotation_deg < 1e-5
    assert rover.tracked == 1.0
    assert np.isnan(puck.rotation_deg), "one marker tells no turn about its normal"
    assert score.all_tracked()


def test_wrong_poses_fail():
    """4 mm pass the limit of 5 mm, 6 mm do not, and the figure is the error."""
    assert faults_of(score_of(0.004)) == []
    score = score_of(0.006)
    assert faults_of(score)[0] == "rover is 6.0 mm RMS from the truth (limit 5 mm)"
    assert score.recent_mm("puck") == pytest.approx(6.0)


def test_a_missing_robot_fails():
    """No pose at all, or none that is tracked."""
    score = Score(truth, ROBOTS)
    score.add(pose_of("rover", SECOND, np.eye(4), "lost"))
    assert faults_of(score) == ["rover was never tracked", "puck was never tracked"]
    assert not score.all_tracked()


def test_a_robot_that_was_lost_fails():
    """0.4 s without it pass, 0.6 s do not; poses come 20 ms apart."""
    assert faults_of(score_of(0.0, (1.0, 1.4))) == []
    (fault,) = faults_of(score_of(0.0, (1.0, 1.6)))
    assert fault == "rover was lost for 0.62 s (limit 0.5 s)"


def test_a_robot_that_is_lost_at_the_end_fails():
    """Silence until the end is a gap, as is silence from the start."""
    assert faults_of(score_of(0.0, (1.3, 9.0))) == ["rover was lost for 0.72 s (limit 0.5 s)"]
    assert faults_of(score_of(0.0, (0.0, 0.7))) == ["rover was lost for 0.70 s (limit 0.5 s)"]


def test_poses_beyond_the_truth_do_not_count():
    """Before the robots come, before the score begins, and robots that nobody declared."""
    score = Score(truth, ROBOTS)
    score.add(pose_of("rover", -SECOND, np.eye(4)))
    score.add(pose_of("stranger", SECOND, np.eye(4)))
    late = Score(truth, ROBOTS, start_ns=3 * SECOND)
    late.add(pose_of("rover", SECOND, np.eye(4)))
    assert late.tracks["rover"].poses == 0
    assert not score.all_tracked()


def test_gaps_stand_between_times_and_the_ends():
    """In whatever order the poses came."""
    assert longest_gap_s([3 * SECOND, SECOND], 0, 4 * SECOND) == 2.0
    assert longest_gap_s([], 0, 4 * SECOND) == 4.0
    assert longest_gap_s([9 * SECOND], 0, 4 * SECOND) == 4.0


def test_angles():
    """Of a rotation by a known angle, up to a half turn."""
    for angle in (0.0, 1e-6, 0.5, np.pi):
        R = rotation_from_vector([0.0, angle, 0.0])
        assert angle_deg(np.eye(3), R) == pytest.approx(np.degrees(angle), abs=1e-6)


def test_a_summary_has_a_line_a_robot():
    """And one of latency where poses had one."""
    results = score_of(0.0).results(0, 2 * SECOND)
    lines = summarise(results, [5.0] * 99 + [50.0])
    assert [line.split(":")[0] for line in lines] == ["rover", "puck", "latency"]
    assert "5.0 ms p50" in lines[-1]
    assert len(summarise(results, [])) == 2
