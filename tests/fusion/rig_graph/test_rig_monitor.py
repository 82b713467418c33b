# SPDX-License-Identifier: BSD-3-Clause
"""A moved camera is found, excluded and recalibrated; the world frame does not change."""

import contextlib
import os
import signal
from collections.abc import Iterable
from concurrent.futures import BrokenExecutor
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from calib.rig.camera import Camera
from camera_node.foundation.background_process import BackgroundProcess
from camera_node.geometry.pose import Pose, rotation_from_vector
from fusion.model.corrections import ExtrinsicsCorrection
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.states import POSITION, FrameSetFit, Snapshot
from fusion.rig_graph.hypotheses import CAUSES, CONFIRMED, RIVAL, Verdict
from fusion.rig_graph.judgements import WINDOWS, judge_latest, watch
from fusion.rig_graph.keyframes import Keyframe, Keyframes
from fusion.rig_graph.robot_shapes import RobotShapes
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import Tracker
from tests.benchmarks.trust import WINDOW_S, Case, run
from tests.fusion.clock_faults import ERROR_M, SIGMAS
from tests.fusion.moved_camera import MOTIONS, MOVE_S, ROBOTS, black, moved
from tests.fusion.rig_graph.fits import fitted
from tests.fusion.synthetic import PERIOD_NS, START_NS, TRIANGLE, WIDE, Arena, ring
from tests.fusion.tracks import errors

DEADLINE_S = 60.0  # of a process that starts on a busy machine
PHASES = dict(zip(ring(), Arena.phases, strict=False))
FRAMES = 170  # of each camera: 20 frame sets that are compared


@pytest.mark.parametrize(
    ("turn_deg", "shift_m"),
    [
        (2.0, 0.0),
        pytest.param(0.0, 0.02, marks=pytest.mark.slow),
        pytest.param(-2.0, 0.02, marks=pytest.mark.ci),
    ],
)
def test_a_moved_camera_is_excluded_within_a_second_and_recalibrated(turn_deg, shift_m):
    """Poses stay within 2 mm. About 300 roundels within 1 m determine the position of a camera 4 m away to 6 mm;
    since its rotation compensates for that, it projects the centre of the arena to within 0.5 px."""
    before, after = moved(turn_deg, shift_m)
    frames = [f for f in before.frames(110) if before.seconds(f.t_ns) < MOVE_S]
    frames += [f for f in after.frames(110) if before.seconds(f.t_ns) >= MOVE_S]
    tracker, synchronizer, excluded, recalibrated, poses = (
        Tracker(before.cameras, ROBOTS),
        FrameSynchronizer(PERIOD_NS),
        [],
        [],
        [],
    )
    for frame in frames:
        synchronizer.add(frame)
        for frame_set in synchronizer.take(frame.t_ns):
            result = tracker.track(frame_set)
            poses += result.poses
            for correction in tracker.check_extrinsics(frame_set):
                assert isinstance(correction, ExtrinsicsCorrection)
                (excluded if correction.camera is None else recalibrated).append(
                    (correction.name, before.seconds(frame_set.t_ns))
                )
    assert [name for name, _ in excluded] == ["cam1"] == [name for name, _ in recalibrated]
    assert excluded[0][1] - MOVE_S < 1.0
    assert recalibrated[0][1] - MOVE_S < 3.5
    T, truth = tracker.cameras["cam1"].matrix(), after.cameras["cam1"].matrix()
    assert np.linalg.norm(T[:3, 3] - truth[:3, 3]) < 6e-3
    middle = [[0.0, 0.0, 0.3]]
    looks = [c.project_world(middle) for c in (tracker.cameras["cam1"], after.cameras["cam1"])]
    assert np.linalg.norm(looks[0] - looks[1]) < 0.5
    for robot in ROBOTS:
        mine = [pose for pose in poses if pose.robot == robot][3:]
        assert all(pose.state == "tracked" for pose in mine)
        assert np.linalg.norm(errors(before, mine)[:, 3:], axis=1).max() < 2e-3


def around(t: float) -> tuple[np.ndarray, np.ndarray]:
    """R and p of a robot that corrections through the arena and rotates."""
    return rotation_from_vector([0, 0, t]), np.array([0.7 * np.sin(0.7 * t), 0.6 * np.cos(0.5 * t), 0.2])


@pytest.mark.parametrize(
    ("off_m", "reported"),
    [
        pytest.param(0.02, True, marks=pytest.mark.ci),
        (0.005, True),
        pytest.param(0.0, False, marks=pytest.mark.ci),
    ],
)
def test_a_misplaced_marker_is_found_and_no_camera_is_blamed(off_m, reported, caplog):
    """The only robot in view of four cameras: 5 mm are 0.8 px, of which a fit of three markers leaves half. Its markers
    are used where they are, but for less than is corrected, also after another robot was declared."""
    (x, y, z), *others = TRIANGLE.markers
    glued = msgspec.structs.replace(TRIANGLE, markers=((x, y + off_m, z), *others))
    arena = Arena({"a": glued}, {"a": around}, sigma_px=0.1)
    tracker = Tracker(arena.cameras, {"a": TRIANGLE})
    corrections, _ = follow(tracker, arena.frames(FRAMES))
    assert corrections == []
    found = tracker.contradictions()
    assert [(c.kind, c.names) for c in found] == ([("robot", ("a",))] if reported else [])
    assert ("robot a" in caplog.text) == reported
    used = distances(tracker.table.markers.position.T)
    np.testing.assert_allclose(used, distances(glued.points), atol=2e-3)
    again = tracker.with_robots({"a": TRIANGLE, "b": WIDE}, {})
    np.testing.assert_array_equal(again.table.markers.position[:, :3], tracker.table.markers.position)


def distances(points: np.ndarray) -> np.ndarray:
    """(m, m) between all markers."""
    return np.linalg.norm(points[:, None] - points, axis=2)


def test_a_correct_camera_is_not_excluded(run_arena):
    """Despite false detections, a hidden marker, a camera without frames for a while, and one whose frames turn black:
    what it saw besides the markers before does not stand for them."""
    arena = Arena(
        ROBOTS, MOTIONS, sigma_px=0.1, distractors=8, hidden=lambda robot, marker, t: marker == 1 and t > 0.5
    )
    frames = [f for f in arena.frames(60) if not (f.camera == "cam2" and 0.5 < arena.seconds(f.t_ns) < 1.2)]
    frames = [black(f) if f.camera == "cam1" and arena.seconds(f.t_ns) > 1.2 else f for f in frames]
    assert follow(Tracker(arena.cameras, ROBOTS), frames)[0] == []


@pytest.mark.ci
def test_of_four_cameras_one_of_which_is_silent_the_moved_one_is_found():
    """Of three cameras that see robots, one that turned looks like the two others that turned together."""
    before, after = moved(2.0, 0.0)
    frames = [f for f in before.frames(90) if before.seconds(f.t_ns) < MOVE_S]
    frames += [f for f in after.frames(90) if before.seconds(f.t_ns) >= MOVE_S]
    corrections, states = follow(Tracker(before.cameras, ROBOTS), [f for f in frames if f.camera != "cam3"])
    assert [(c.name, c.camera is None) for c in corrections] == [("cam1", True), ("cam1", False)]
    assert states == ["tracked"] * len(ROBOTS)


@pytest.mark.parametrize(
    ("turn_deg", "axis", "excluded"),
    [pytest.param(1.0, (0.36, 0.92, -0.16), False, marks=pytest.mark.ci), (3.0, (-0.88, -0.43, 0.2), True)],
)
def test_of_two_cameras_one_of_which_turns_no_pose_is_wrong(turn_deg, axis, excluded):
    """By one degree robots appear 60 mm away, with the same residuals in all windows: undecided, and some are too
    uncertain to be called tracked. By three, most markers appear elsewhere in the image of this camera alone: it was
    moved. One that was taken for another displaced its robot."""
    before, after = moved(turn_deg, 0.0, axis)
    frames = [f for f in before.frames(80) if before.seconds(f.t_ns) < MOVE_S]
    frames += [f for f in after.frames(80) if before.seconds(f.t_ns) >= MOVE_S]
    tracker = Tracker({name: before.cameras[name] for name in ("cam0", "cam1")}, ROBOTS)
    synchronizer, wrong, corrections, tracked = FrameSynchronizer(PERIOD_NS), [], [], []
    for frame in frames:
        if frame.camera in tracker.cameras.names:
            synchronizer.add(frame)
        for frame_set in synchronizer.take(frame.t_ns):
            poses = [pose for pose in tracker.track(frame_set).poses if pose.state != "lost"]
            tracked.append(len(poses))
            for pose in poses:
                error, P = errors(before, [pose])[0, 3:], pose.covariance_matrix[POSITION, POSITION]
                is_wrong = error @ np.linalg.solve(P, error) > SIGMAS**2 and np.linalg.norm(error) > ERROR_M
                wrong += [(pose.robot, error)] if is_wrong else []
            corrections += tracker.check_extrinsics(frame_set)
    assert wrong == []
    assert set(tracked[10:]) == {len(ROBOTS)}
    assert [(c.name, c.camera) for c in corrections] == ([("cam1", None)] if excluded else [])
    contradicting = [c.names for c in tracker.monitors.rig.contradictions()]
    assert contradicting == ([] if excluded else [("cam0", "cam1")])


def put(t: float) -> tuple[np.ndarray, np.ndarray]:
    """R and p of a robot that is put elsewhere at once."""
    R, p = around(t)
    return R, np.add(p, [0.0, 0.3 * (t > MOVE_S), 0.0])


def test_a_robot_that_is_put_elsewhere_moves_no_camera():
    """The camera whose frame is the first after that shows all markers elsewhere, and then all cameras do."""
    arena = Arena({"a": TRIANGLE}, {"a": put}, sigma_px=0.1)
    cameras = {name: arena.cameras[name] for name in ("cam0", "cam1")}
    frames = [f for f in arena.frames(60) if f.camera in cameras]
    assert follow(Tracker(cameras, {"a": TRIANGLE}), frames) == ([], ["tracked"])


def test_a_robot_that_only_one_camera_sees_does_not_show_that_this_one_moved():
    """The other one shows nothing from before the robot is put elsewhere."""
    arena = Arena({"a": TRIANGLE}, {"a": put}, sigma_px=0.1)
    cameras = {name: arena.cameras[name] for name in ("cam0", "cam1")}
    tracker, synchronizer, displaced = Tracker(cameras, {"a": TRIANGLE}), FrameSynchronizer(PERIOD_NS), []
    for frame in (f for f in arena.frames(40) if f.camera in cameras):
        hidden = frame.camera == "cam1" and arena.seconds(frame.t_ns) > 0.5
        synchronizer.add(black(frame) if hidden else frame)
        for frame_set in synchronizer.take(frame.t_ns):
            tracker.track(frame_set)
            displaced += tracker.own.displaced
    assert displaced == []


@pytest.mark.ci
def test_two_of_three_cameras_that_are_moved_one_after_the_other_stay_excluded():
    """By 3 degrees, each shows most markers elsewhere. One camera does not show their new poses, and a robot that is
    where it was for this one does not bring them back."""
    before, after = moved(3.0, 0.0, (-0.88, -0.43, 0.2))
    T = before.cameras["cam2"].matrix()
    T[:3, :3] = T[:3, :3] @ rotation_from_vector([0.04, -0.03, 0.01])
    turned = msgspec.structs.replace(before.cameras["cam2"], T_world_cam=Pose.from_matrix(T))
    both = Arena(ROBOTS, MOTIONS, cameras=after.cameras | {"cam2": turned}, sigma_px=0.1)
    times = [0.0, MOVE_S, 2 * MOVE_S, np.inf]
    frames = [
        frame
        for arena, begin, end in zip((before, after, both), times, times[1:], strict=False)
        for frame in arena.frames(90)
        if begin <= arena.seconds(frame.t_ns) < end and frame.camera != "cam3"
    ]
    cameras = {name: camera for name, camera in before.cameras.items() if name != "cam3"}
    corrections, _ = follow(Tracker(cameras, ROBOTS), frames)
    excluded = [c.name for c in corrections if c.camera is None]
    assert excluded == ["cam1", "cam2"]
    assert not any(c.has_returned for c in corrections)


@pytest.mark.ci
def test_of_many_cameras_of_which_three_see_robots_none_is_blamed(caplog):
    """Nothing is remembered that would show which of them moved: the judgement ended in an exception."""
    cameras = ring(5)
    T = cameras["cam1"].matrix()
    T[:3, :3] = T[:3, :3] @ rotation_from_vector([0.006, 0.004, 0.0])
    turned = msgspec.structs.replace(cameras["cam1"], T_world_cam=Pose.from_matrix(T))
    after = Arena(ROBOTS, MOTIONS, cameras=cameras | {"cam1": turned}, sigma_px=0.1)
    before = Arena(ROBOTS, MOTIONS, cameras=cameras, sigma_px=0.1)
    frames = [f for f in before.frames(60) if before.seconds(f.t_ns) < MOVE_S]
    frames += [f for f in after.frames(60) if before.seconds(f.t_ns) >= MOVE_S]
    corrections, _ = follow(Tracker(cameras, ROBOTS), [f for f in frames if f.camera != "cam3"])
    assert corrections == []
    assert "can't be judged" not in caplog.text


@pytest.mark.ci
def test_robots_are_found_while_claims_count_large_errors_and_these_end():
    """Cameras that contradicted each other agree again: claims stayed as large, and let no robot be found that would
    have shown that."""
    arena = Arena(ROBOTS, MOTIONS, sigma_px=0.1)
    tracker = Tracker(arena.cameras, ROBOTS)
    tracker.cameras.count_errors(300.0, 0.0)
    assert follow(tracker, arena.frames(180)) == ([], ["tracked"] * len(ROBOTS))
    assert tracker.cameras.error_scale == 1.0


def follow(tracker: Tracker, frames: list[CalibratedFrame]) -> tuple[list[ExtrinsicsCorrection], list[str]]:
    """The corrections of cameras, and the states of all robots in the end."""
    synchronizer, corrections, states = FrameSynchronizer(PERIOD_NS), [], []
    for frame in frames:
        synchronizer.add(frame)
        for frame_set in synchronizer.take(frame.t_ns):
            states = [pose.state for pose in tracker.track(frame_set).poses]
            corrections += tracker.check_extrinsics(frame_set)
    return corrections, states


def test_a_clock_that_a_judgement_blames_is_in_doubt_until_others_confirm_it():
    arena = Arena(ROBOTS, MOTIONS)
    tracker, n = Tracker(arena.cameras, ROBOTS), len(arena.cameras)
    monitors, fit = tracker.monitors, fitted("clock", (1,), n, 0.0)
    fit.errors[1, CAUSES["clock"]] = 0.012
    monitors.rig._note_clocks(Verdict("clock", (1,), fit), None)
    name = tracker.cameras.names[1]
    assert monitors.rig.clock_doubts == {name: 0.012}
    monitors.rig.readmit(name)  # what it was judged by was an old pose
    assert not monitors.rig.clock_doubts


def gathered(arena: Arena, frames: Iterable[CalibratedFrame]) -> tuple[Tracker, tuple[Keyframe, ...]]:
    """A tracker that followed the frames, and the last keyframes."""
    tracker, synchronizer = Tracker(arena.cameras, ROBOTS), FrameSynchronizer(PERIOD_NS)
    robots, keyframes = tracker.table, Keyframes(tracker.cameras, tracker.table.markers, min(WINDOWS))
    for frame in frames:
        synchronizer.add(frame)
        for frame_set in synchronizer.take(frame.t_ns):
            tracker.track(frame_set)
            keyframes.add(frame_set, Snapshot(frame_set.t_ns, robots.states, robots.located))
    return tracker, tuple(keyframes.kept)


@pytest.mark.parametrize(("n_cameras", "doubted"), [(2, {0, 1}), (4, {1})])
def test_clocks_that_explain_keyframes_alike_are_in_doubt_together(n_cameras: int, doubted: set[int]):
    """The stamps of cam1 jump by 10 ms: two cameras show only the difference of their clocks."""
    arena = Arena(ROBOTS, MOTIONS, cameras=dict(list(ring().items())[:n_cameras]), sigma_px=0.1)
    jumped = [
        replace(f, t_ns=f.t_ns + 10_000_000 * (f.camera == "cam1" and arena.seconds(f.t_ns) > 1.0))
        for f in arena.frames(90)
    ]
    tracker, keyframes = gathered(arena, jumped)
    watched = watch(keyframes, tracker.cameras, tracker.table.markers)
    assert watched.clock_gain > chi2.isf(RIVAL, 1)
    assert set(watched.offsets_s) == doubted
    assert watched.offsets_s[1] == pytest.approx(0.01, rel=0.2)


def test_keyframes_in_which_no_marker_is_assigned_show_nothing():
    """As of robots that leave all views. A fit without an observation has no logarithm of their number: the job failed,
    and the log had its traceback."""
    arena = Arena(ROBOTS, MOTIONS, sigma_px=0.1)
    tracker, keyframes = gathered(arena, arena.frames(90))
    empty, markers = tuple(replace(keyframe, views=()) for keyframe in keyframes), tracker.table.markers
    assert len(empty) == min(WINDOWS)
    assert watch(empty, tracker.cameras, markers).offsets_s == {}
    assert judge_latest(empty, tracker.cameras, markers, RobotShapes(markers), 0, ()) is None


def test_a_process_that_judges_is_started_again_after_it_was_killed():
    """A job that it took with it fails, as the monitor expects."""
    with BackgroundProcess() as judge:
        first = judge.submit(os.getpid).result(DEADLINE_S)
        os.kill(first, signal.SIGKILL)
        with contextlib.suppress(BrokenExecutor):  # unless the end was noticed before the job came
            judge.submit(os.getpid).result(DEADLINE_S)
        assert judge.submit(os.getpid).result(DEADLINE_S) not in {first, os.getpid()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "cameras", "reported"),
    [
        ("drifting 0.3 deg in 10 s", 3, "undecided"),
        ("drifting 0.3 deg in 10 s", 4, "right"),
        ("bar 0.5 deg", 3, "undecided"),
        ("bar 0.5 deg", 4, "undecided"),
        ("turned 3 deg", 3, "right"),
        ("focal +0.2 %", 8, "right"),
        ("focal +0.7 %", 4, "right"),
        ("focal of all +0.5 %", 4, "right"),
        ("wand 1 % short", 4, "right"),
    ],
)
def test_no_other_camera_or_robot_is_reported(kind: str, cameras: int, reported: str):
    """A pose that drifts on after its new pose is known is no clock of another camera; two cameras that turn together
    displace no robot's markers; of three cameras they look like the third one, but for the motion of the robots."""
    outcome = run(Case(kind=kind, cameras=cameras, seed=0))
    assert outcome.report == reported, outcome.lines
    assert outcome.rewritten == []
    if reported == "right":  # corrected, or claimed
        assert max(outcome.ratios[1:]) < 2.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "cameras", "robots", "speed_m_s", "seed", "found_s"),
    [
        ("clock 2000 ppm", 3, 1, 0.5, 4, 2),
        ("drifting 0.3 deg in 10 s", 4, 4, 0.1, 2, 2),
        ("focal of all +0.5 %", 6, 1, 0.1, 3, 4),
        ("wand 1 % short", 8, 1, 0.0, 5, 2),
    ],
)
def test_what_robots_hardly_show_blames_no_innocent_camera(
    kind: str, cameras: int, robots: int, speed_m_s: float, seed: int, found_s: int
):
    """A clock was taken for lenses, a refinement of 1.4 standard deviations named an innocent camera, and what all
    lenses or the whole rig have in common was not found: 7 and 25 mm, 80 and 380 times the claim. One slow robot shows
    what all lenses have in common after three seconds."""
    case = Case(kind=kind, cameras=cameras, seed=seed, robots=robots, speed_m_s=speed_m_s)
    outcome = run(case)
    assert outcome.report == "right", outcome.lines
    assert outcome.rewritten == []
    assert max(outcome.ratios[round(found_s / WINDOW_S) :]) < 2.0


@pytest.mark.ci
def test_markers_that_several_labelings_explain_are_not_elsewhere():
    """Claims contain 20 mm, of a wand that is 1 % short, so that three detections may be any of four markers, and are
    not assigned. They are where they are predicted; the camera was excluded as moved, and squared errors were 258 times
    their claim."""
    outcome = run(Case(kind="wand 1 % short", cameras=3, seed=0, robots=1, speed_m_s=0.0))
    assert not [line for line in outcome.lines if "was moved" in line]
    assert max(outcome.ratios[1:]) < 2.0


def test_a_camera_that_shows_all_elsewhere_is_excluded_unless_several_contradict_each_other():
    """By then the one at fault may predict the robots, as it may until the rig has held."""
    tracker = Tracker(moved(0.0, 0.0)[0].cameras, ROBOTS)
    monitor, states = tracker.monitors.rig, tracker.table.states
    now, fit = Snapshot(START_NS, states, np.zeros(len(states), bool)), FrameSetFit(False, {1: CONFIRMED})
    assert monitor.check(FrameSet(START_NS, ()), now, fit, True) == ()
    monitor._held = True
    monitor.contradicting = tracker.cameras.names
    assert monitor.check(FrameSet(START_NS, ()), now, fit, True) == ()
    monitor.contradicting = ()
    corrections = monitor.check(FrameSet(START_NS, ()), now, fit, True)
    assert [(c.name, c.camera) for c in corrections if isinstance(c, ExtrinsicsCorrection)] == [
        ("cam1", None)
    ]


@pytest.mark.ci
@pytest.mark.parametrize(
    ("kind", "seed", "robots", "speed_m_s"), [("bar 0.5 deg", 7, 1, 0.5), ("bar 0.5 deg", 7, 4, 0.5)]
)
def test_two_cameras_that_were_off_from_the_start_are_found(
    kind: str, seed: int, robots: int, speed_m_s: float
):
    """Of six. Before one robot, neither of them explained much alone, so the pair was not compared, and four innocent
    cameras were rewritten. Before four, no hypothesis explained the mixed up robots of the first windows: claims did
    not say so for eight seconds, in which poses were 40 mm off with a claim of 1 mm."""
    outcome = run(Case(kind=kind, cameras=6, seed=seed, at_start=True, robots=robots, speed_m_s=speed_m_s))
    assert outcome.report == "right", outcome.lines
    assert not outcome.rewritten
    assert not any(ratio > 2.0 for ratio in outcome.ratios[1:])


@pytest.mark.parametrize(
    ("kind", "cameras", "seed", "robots"),
    [
        pytest.param("wand 1 % short", 4, 1, 1, marks=pytest.mark.ci),
        pytest.param("focal +0.7 %", 4, 7, 4, marks=pytest.mark.slow),
        pytest.param("marker 20 mm off", 6, 6, 4, marks=pytest.mark.slow),
    ],
)
def test_until_robots_are_judged_claims_count_that_the_rig_may_have_changed(
    kind: str, cameras: int, seed: int, robots: int
):
    """Robots agree with a rig of another size until sizes are compared: 24 mm off, 440 times the claim."""
    outcome = run(
        Case(kind=kind, cameras=cameras, seed=seed, robots=robots, at_start=kind.startswith("focal"))
    )
    assert outcome.report == "right", outcome.lines
    assert max(outcome.ratios) < 2.0


def test_a_rig_is_doubted_until_the_first_judgement():
    """Or for three seconds, if no two cameras see a robot; one camera is not doubted."""
    arena = Arena(ROBOTS, MOTIONS, sigma_px=0.1)
    judged = doubted(arena.cameras)
    follow(judged, arena.frames(40))
    assert not judged.monitors.rig.is_doubted
    plain = Tracker(arena.cameras, ROBOTS)
    follow(plain, arena.frames(40))
    np.testing.assert_array_equal(judged.table.claimed, plain.table.claimed)

    def seen_alone(n: int) -> Tracker:
        tracker = doubted(arena.cameras)
        follow(tracker, [frame for frame in arena.frames(n) if frame.camera == "cam0" or n_set(frame) < 3])
        return tracker

    def n_set(frame: CalibratedFrame) -> int:
        return round((frame.t_ns - START_NS) / PERIOD_NS)

    before, after = seen_alone(60), seen_alone(110)
    assert before.monitors.rig.is_doubted
    np.testing.assert_array_equal(before.with_robots(ROBOTS, {}).table.claimed, before.table.claimed)
    assert not after.monitors.rig.is_doubted
    assert not doubted({"cam0": arena.cameras["cam0"]}).monitors.rig.is_doubted


def doubted(cameras: dict[str, Camera]) -> Tracker:
    """A tracker as of a server."""
    tracker = Tracker(cameras, ROBOTS)
    tracker.monitors.rig.doubt()
    return tracker


@pytest.mark.ci
def test_a_displaced_camera_is_not_excluded_while_cameras_contradict_each_other():
    """One robot at rest before three cameras: by then the one at fault predicted it. An innocent camera was excluded,
    and poses by the two others were 113 mm off with a claim of 10 mm."""
    outcome = run(Case(kind="turned 3 deg", cameras=3, seed=3, robots=1, speed_m_s=0.0))
    assert outcome.report in ("right", "undecided"), outcome.lines
    assert not any(ratio > 2.0 for ratio in outcome.ratios)  # NaN: not tracked


@pytest.mark.ci
def test_a_camera_is_judged_though_every_second_frame_set_contradicts_the_predictions():
    """A robot at rest before three cameras follows the one that turned, and the others, in turns. Each beginning of a
    contradiction made the keyframes before it useless, so that nothing was judged: 8 mm off with a claim of 3."""
    outcome = run(Case(kind="turned 0.3 deg", cameras=3, seed=5, robots=1, speed_m_s=0.0))
    assert outcome.report in ("right", "undecided"), outcome.lines
    assert max(outcome.ratios[1:]) < 2.0


@pytest.mark.ci
@pytest.mark.parametrize(("seed", "robots"), [(4, 1), (8, 4)])
def test_two_cameras_that_moved_together_are_excluded_together(seed: int, robots: int):
    """Of a pair on one bar the first one was: poses by the second one were up to 130 mm off until it was judged. Where
    the first one is seen to show its markers elsewhere, it may be one of two: larger errors of all cameras were said to
    explain the rest, so that it was used again, three times, and poses had 73 times their claim."""
    outcome = run(Case(kind="bar 0.5 deg", cameras=6, seed=seed, robots=robots))
    assert outcome.report == "right", outcome.lines
    assert all("was moved" in line for line in outcome.lines[:2]), outcome.lines
    assert max(outcome.ratios[1:]) < 2.0


@pytest.mark.slow
def test_robots_at_rest_show_no_clock():
    """Noise was their velocity: a camera that turned by 0.1 degrees got a clock of 1.3 s, and a good clock drifted."""
    turned = run(Case(kind="turned 0.1 deg", cameras=4, seed=0, robots=1, speed_m_s=0.0))
    jumped = run(Case(kind="clocks of 1/2 +40 ms", cameras=3, seed=0, robots=1, speed_m_s=0.0))
    lines = turned.lines + jumped.lines
    assert not any("drifts" in line or "no longer corrected" in line for line in lines), lines


@pytest.mark.slow
def test_claims_are_as_before_once_the_camera_that_was_moved_has_its_new_pose():
    """While nothing is decided they count the errors of all cameras as larger; the new rig must not state these."""
    case = Case(kind="turned 0.1 deg", cameras=3, seed=0)
    outcome = run(case)
    assert outcome.report == "right", outcome.lines
    degrees = 3 * case.robots
    assert min(outcome.ratios[1:]) > chi2.ppf(1e-3, degrees) / degrees


def test_a_moved_camera_is_used_again_among_cameras_of_other_rates():
    """cam0 is three times as fast as the others, of which cam1 exposes one period earlier: no frame set has frames of
    all. Keyframes were every third frame set: they had frames of the same two or three cameras each."""
    before, after = moved(2.0, 0.0)
    frames = [f for f in before.frames(FRAMES) if is_exposed(f) and before.seconds(f.t_ns) < MOVE_S]
    frames += [f for f in after.frames(FRAMES) if is_exposed(f) and before.seconds(f.t_ns) >= MOVE_S]
    tracker = Tracker(before.cameras, ROBOTS)
    corrections, states = follow(tracker, frames)
    assert [(c.name, c.camera is None) for c in corrections] == [("cam1", True), ("cam1", False)]
    assert set(states) == {"tracked"}
    looks = [c.project_world([[0.0, 0.0, 0.3]]) for c in (tracker.cameras["cam1"], after.cameras["cam1"])]
    assert np.linalg.norm(looks[0] - looks[1]) < 0.5


def is_exposed(frame: CalibratedFrame) -> bool:
    """Whether a camera exposes then, of a rate that is a third for all but cam0."""
    number = round((frame.t_ns - START_NS) / PERIOD_NS - PHASES[frame.camera])
    return frame.camera == "cam0" or number % 3 == (frame.camera != "cam1")
