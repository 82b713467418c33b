# SPDX-License-Identifier: BSD-3-Clause
"""Robots before cameras with rolling shutters: each detection is fused at the time of its row."""

from dataclasses import replace

import numpy as np
import pytest

from fusion.model.expected_views import ExpectedViews
from fusion.model.frames import FrameSet
from fusion.model.observations import CameraArray, DetectionTable, MarkerTable, MatchedObservations
from fusion.model.states import States
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.estimator import Estimator
from fusion.tracking.tracker import Tracker
from tests.benchmarks.rolling_shutter import track_in_shutters
from tests.fusion.rendered_arena import RenderedArena
from tests.fusion.synthetic import PERIOD_NS, SINGLE, TRIANGLE, WIDE, Arena, drive, line

READOUT_S, SPEED = 0.03, 2.0
ROBOTS = {"a": TRIANGLE, "b": WIDE}
MOTIONS = {"a": drive(0.5, SPEED), "b": drive(0.8, SPEED)}
FRAMES, DRIVING_S = 75, 1.5


def position_error(readout_s: float, uses_rows: bool = True) -> float:
    """RMS error, mm, of robots that drive at 2 m/s; no camera may count as moved or as one with a wrong clock.

    Without row times the cameras are not judged: a rig that is judged counts the displaced markers as its own errors,
    and robots hold to their predictions.
    """
    arena = Arena(ROBOTS, MOTIONS, sigma_px=0.1, readout_s=readout_s)
    tracker, synchronizer, squared = Tracker(arena.cameras, ROBOTS), FrameSynchronizer(PERIOD_NS), []
    for frame in arena.frames(FRAMES):
        synchronizer.add(frame if uses_rows else replace(frame, readout_s=0.0))
        for frame_set in synchronizer.take(frame.t_ns):
            tracker.track(frame_set)
            if uses_rows:
                assert not tracker.check_extrinsics(frame_set)
                assert all(clock.state == "correct" for clock in tracker.monitors.clocks.health().values())
            if Arena.seconds(frame_set.t_ns) > DRIVING_S:
                assert tracker.table.tracked.all()
                truth = np.array([arena.truth(name, frame_set.t_ns)[1] for name in ROBOTS])
                squared.append(((tracker.table.states.p - truth) ** 2).sum(1))
    return 1e3 * float(np.sqrt(np.mean(squared)))


@pytest.mark.ci
def test_errors_are_those_of_a_global_shutter():
    """Within 1.3 times; without the row times, markers are off by up to half of 30 ms at 2 m/s."""
    exact = position_error(0.0)
    assert position_error(READOUT_S) < 1.3 * exact
    assert position_error(-READOUT_S) < 1.3 * exact
    assert position_error(READOUT_S, uses_rows=False) > 3 * exact


@pytest.mark.slow
def test_errors_in_images_are_those_of_a_global_shutter():
    """Each row of a rendered image is of another time, so discs are displaced and sheared. With row times, errors of
    centres and of normals stay in proportion to what the filter claims; robots with one marker have theirs from the
    shape of the outline alone. Without row times they are displaced by up to 30 mm."""
    exact, ignored, used = track_in_shutters(RenderedArena, READOUT_S, SPEED, FRAMES, seed=1)
    assert exact.tracked == used.tracked == 1
    assert used.position_mm < 1.3 * exact.position_mm < 0.4 * ignored.position_mm
    assert used.nees < 1.3 * max(1.0, exact.nees)
    assert used.single_mm < 1.3 * exact.single_mm < 0.2 * ignored.single_mm
    assert used.single_nees < 1.3


def moving_disc(velocity: tuple[float, float, float]) -> tuple[Arena, States, MatchedObservations]:
    """A single marker in one frame of each camera, and its true state at the time of the frames."""
    arena = Arena(
        {"a": SINGLE}, {"a": line((0.3, 0.2, 0.2), velocity)}, readout_s=READOUT_S, phases=(0.0,) * 4
    )
    frames = arena.frames(1)
    cameras, markers = CameraArray(arena.cameras), MarkerTable.of([SINGLE])
    R, p = arena.truth("a", frames[0].t_ns)
    states = States(R[None], p[None], np.zeros((1, 3)), np.array([velocity]), np.eye(12)[None])
    table = DetectionTable.of(FrameSet(frames[0].t_ns, tuple(frames)), cameras)
    rows = np.zeros(len(table), np.intp)
    return arena, states, MatchedObservations.of_discs(table, markers.discs(rows, table.frame))


@pytest.mark.parametrize("velocity", [(SPEED, 0.0, 0.0), (0.0, SPEED, 0.0), (-1.0, -1.0, 1.0)])
def test_a_moving_disc_is_where_its_row_saw_it(velocity: tuple[float, float, float]):
    """The state predicts the centre of every outline. Its row is that of the outline's centre, up to 0.2 px from the
    disc's own: at 600 px/s and 50 us a row, that is 0.006 px."""
    arena, states, seen = moving_disc(velocity)
    views = CameraArray(arena.cameras).views(states, seen.detections.exposures, seen.discs)
    assert len(seen) == 4
    assert views.xy == pytest.approx(seen.detections.xy, abs=6e-3 / 650)


def test_outlines_are_straightened():
    """The ratio of the axes of a disc that moves at 2 m/s is that of a disc at rest, to second order in the shear of
    1 to 2 %."""
    arena, states, seen = moving_disc((SPEED, 0.0, 0.0))
    estimator = Estimator(CameraArray(arena.cameras), np.ones((1, 2)), np.array([True]))
    straight = estimator._straighten(states, seen)
    off = []
    for observations in (seen, straight):
        poses = estimator.cameras.frame_poses(states, observations.detections.exposures)
        given, sigma = observations.detections, np.ones(len(observations))
        rows = poses.linearize_outlines(
            observations.discs.columns, given.axes_px, given.angle_rad, given.scale, sigma
        )
        off.append(np.abs(rows[:, :, 12]).max())
    assert off[0] > 5e-3
    assert off[1] < 5e-4


def test_monitors_expect_markers_at_their_rows():
    """The predicted row of a marker is that at the frame's middle time: an error of second order in the row's speed,
    2 % of 2 % of 600 rows at most."""
    arena, states, seen = moving_disc((SPEED, 0.0, 0.0))
    cameras, markers = CameraArray(arena.cameras), (MarkerTable.of([SINGLE]), np.arange(1))
    for name, frame in zip(arena.cameras, range(4), strict=True):
        expected = ExpectedViews.of(cameras, name, states, 0.0, markers, READOUT_S)
        still = ExpectedViews.of(cameras, name, states, 0.0, markers)
        uv = seen.detections.uv[:, seen.detections.frame == frame].T
        assert expected.uv == pytest.approx(uv, abs=0.25)
        assert np.abs(still.uv - uv).max() > np.abs(expected.uv - uv).max()
