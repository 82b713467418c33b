# SPDX-License-Identifier: BSD-3-Clause
"""Detections of several cameras as markers: points of unknown size in two views, and markers that move."""

from dataclasses import replace

import numpy as np
import pytest

from fusion.model.frames import FrameSet
from fusion.tracking.ray_pairs import _marginals
from fusion.tracking.single_view import CONFIRMED
from fusion.tracking.tracker import Tracker
from tests.benchmarks.fusion_accuracy import frame_sets
from tests.benchmarks.fusion_grouping import (
    FREE_RUNNING,
    SCENES,
    SIDE_BY_SIDE,
    Scene,
    in_direction,
    moving_markers,
    moving_score,
    score,
)
from tests.benchmarks.fusion_load import Load
from tests.fusion.synthetic import TRIANGLE, Arena, line

SEEN = Arena({"a": TRIANGLE}, {"a": line((0, 0, 0.3))})


@pytest.mark.parametrize(
    ("name", "recall_of_two"),
    [
        ("34 points, 2 cameras 1 m apart", 0.9),
        ("34 points, 2 cameras around", 0.95),
        ("34 points, 3 cameras around, poses off", 0.95),
        ("130 points, 4 cameras 0.6 m apart", 0.9),
    ],
)
def test_points_in_two_views_are_found(name: str, recall_of_two: float):
    """With a gate of fixed width, 0.64, 0.93, 0.68 and 0.19 of them were found, with a precision down to 0.80."""
    got = score(SCENES[name], range(6))
    assert got.of_two >= 30
    assert got.recall_of_two >= recall_of_two
    assert got.precision >= 0.99


def test_cameras_side_by_side_are_grouped_precisely():
    """All epipolar lines are parallel here, so that many pairs of rays intersect by chance."""
    got = score(SIDE_BY_SIDE, range(3))
    assert got.precision >= 0.99
    assert got.recall >= 0.9


def test_false_roundels_make_no_points():
    """Of 30 in each of two cameras, 3 pairs of rays pass each other within the noise by chance."""
    got = score(SCENES["30 false roundels in 2 cameras"], range(20))
    assert got.markers <= 2  # of 20 arenas


def test_more_noise_makes_fewer_points_not_wrong_ones():
    """Poses that are off by 3 px: the misses are larger than any allowance, and few pairs are probable."""
    got = score(Scene(baseline_m=1.0, turned_rad=3e-3), range(6))
    assert got.correct >= 0.95 * got.markers


@pytest.mark.parametrize("seed", range(4))
def test_probabilities_of_pairs_are_those_of_all_sets_of_pairs(seed: int):
    """On a graph without cycles belief propagation is exact: compared with the sum over all sets of pairs."""
    rng = np.random.default_rng(seed)
    n = 8
    pairs = np.array([[rng.integers(0, k), k] for k in range(1, n)]).T  # a random tree
    ratios = np.exp(rng.normal(0, 2, pairs.shape[1]))
    total, each = 0.0, np.zeros(len(ratios))
    for chosen in range(1 << len(ratios)):
        rows = [k for k in range(len(ratios)) if chosen >> k & 1]
        if len(np.unique(pairs[:, rows])) == 2 * len(rows):
            weight = float(np.prod(ratios[rows]))
            total += weight
            each[rows] += weight
    messages = np.full((2, len(ratios)), 0.5)
    for _ in range(7):  # more passes than edges on any path
        messages = _marginals(pairs, ratios, messages, n)[1]
    got = _marginals(pairs, ratios, messages, n)[0]
    np.testing.assert_allclose(got, each / total, atol=1e-6)


@pytest.mark.parametrize("speed_m_s", [0.0, 1.0])
def test_markers_before_free_running_cameras_are_as_precise_as_stated(speed_m_s: float):
    """Errors are within the stated covariance, without the few markers that are made of rays of two discs. At rest all
    are found, and the covariance does not contain the 60 mm that a marker could have moved between two frames, because
    eight views show that it did not."""
    found, number, places = moving_markers(in_direction(speed_m_s), FREE_RUNNING)
    discs = [set(number[marker.detections].tolist()) for marker in found]
    right = {min(disc): marker for disc, marker in zip(discs, found, strict=True) if len(disc) == 1}
    error = np.array([marker.position - places[disc] for disc, marker in right.items()])
    cov = np.array([marker.covariance for marker in right.values()])
    assert np.mean(np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[:, :, None])[:, :, 0])) < 3
    if speed_m_s:
        assert len(right) >= 0.95 * len(places)
    else:
        assert len(right) == len(found) == len(places)
        assert np.sqrt(np.trace(cov, axis1=1, axis2=2)).max() < 4e-3


def test_rays_have_the_times_of_their_rows():
    """Cameras expose at once with a readout of 30 ms. At 2 m/s the rows of opposite cameras, up to 400 px apart, see a
    marker 40 mm apart, four times what noise explains."""
    found, number, places = moving_markers(in_direction(2.0), (0.0,) * 4, 0.35, readout_s=0.03)
    discs = [set(number[marker.detections].tolist()) for marker in found]
    right = [disc for disc in discs if len(disc) == 1]
    assert len(right) == len(discs) == len(set.union(*right))
    assert len(right) >= 0.95 * len(places)
    assert sum(len(marker.detections) for marker in found) >= 0.95 * len(number)


@pytest.mark.parametrize(("apart_m", "off"), [(0.35, 0), (0.15, 0), (0.15, 6)])
def test_rays_of_several_discs_that_motion_lets_meet_make_no_marker(apart_m: float, off: int):
    """Four free-running cameras, 2 m/s: before the sizes of all groups were compared, 9 % of the markers 0.15 m apart
    were made of rays of several discs. Six discs that are 12 % smaller than declared are found like the others."""
    got, found_off = moving_score(2.0, 4, apart_m, range(4), off)
    assert got.precision >= 0.99
    assert got.recall >= 0.95
    assert found_off == 4 * off


def test_a_marker_that_appears_is_found_soon_although_no_robot_is_missing():
    """Detections of one frame set are not searched without a cause; those that stay are one."""
    load = Load(2, 4, 4, 30.0, missing=0.0)
    both = zip(frame_sets(load, 1.2), frame_sets(replace(load, clutter=1), 1.2), strict=True)
    tracker, found = Tracker(load.rig, load.bodies), []
    for k, (without, with_marker) in enumerate(both):
        tracker.acquisition.search.n_frame_sets *= (
            k > 20
        )  # the next search without a cause is eight frame sets later
        markers = tracker.track(with_marker if k > 20 else without).markers
        by_several = np.isnan(np.frombuffer(markers.candidates, "<f4").reshape(-1, 6)[:, 0])
        found.append(np.flatnonzero((np.frombuffer(markers.robot, "<i4") < 0) & by_several))
    assert tracker.table.tracked.all()
    assert not any(map(len, found[15:21]))
    seen = [len(rows) for rows in found[21:]]
    first = seen.index(1)
    assert first <= CONFIRMED + 1
    assert set(seen[first:]) == {1}, "one marker, found by several cameras"


def test_of_several_frames_of_a_camera_one_is_searched():
    """A busy server gets many frames in one set. A robot at 2 m/s is 13 cm further in the last one of three, so rays of
    different times do not meet; and the search of 12 frames took 0.7 s."""
    arena = replace(SEEN, motions={"a": line((-0.3, -0.2, 0.3), (2.0, 0.3, 0.0))})
    frames = [frame for frame in arena.frames(3) if frame.camera != "cam3"]
    tracker = Tracker(arena.cameras, arena.robots)
    t_ns = sorted(frame.t_ns for frame in frames)[len(frames) // 2]
    result = tracker.track(FrameSet(t_ns, tuple(frames)))
    assert [pose.state for pose in result.poses] == ["tracked"]
    at = np.repeat(np.arange(len(frames)), [len(frame.roundels) for frame in frames])
    seen_in = np.unique(at[result.assignments.detection])
    assert sorted(frames[k].camera for k in seen_in) == ["cam0", "cam1", "cam2"]
    assert np.linalg.norm(result.poses[0].position - arena.truth("a", t_ns)[1]) < 1e-3
