# SPDX-License-Identifier: BSD-3-Clause
"""The wand is located in the latest frames of placed cameras."""

from dataclasses import replace

import numpy as np

from calib.live.wand_position import locate_wand
from calib.rig.camera import transform
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from tests.calib.synthetic import record, ring

ARENA = ring(3)


def latest_frames(messages: list[Detections], t_ns: int) -> dict[str, Detections]:
    """The last frame of each camera at a time."""
    return {m.camera: m for m in sorted(messages, key=lambda m: m.t_ns) if m.t_ns <= t_ns}


def test_the_wand_is_where_it_is():
    """Whenever two cameras see all its markers: of exact simultaneous frames, to what perspective shifts ellipses."""
    messages, n_seen = record(ARENA, 4.0, free_running=False), 0
    for t_ns in sorted({m.t_ns for m in messages}):
        frames = latest_frames(messages, t_ns)
        if sum(len(frame) == len(ARENA.wand.markers) for frame in frames.values()) < 2:
            continue
        n_seen += 1
        points = locate_wand(ARENA.truth.placed(), ARENA.wand, frames)
        assert points is not None
        true = transform(ARENA.wand_pose(t_ns * 1e-9), ARENA.wand.points)
        assert np.abs(points - true).max() < 5e-3
    assert n_seen > 10


def test_a_wand_of_two_markers_is_where_it_is():
    """In any order of its ends, which look alike, whenever two cameras see both."""
    wand = Body(diameter_m=0.1, markers=((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)))
    arena = replace(ring(3), wand=wand)
    messages, n_seen = record(arena, 4.0, free_running=False), 0
    for t_ns in sorted({m.t_ns for m in messages}):
        frames = latest_frames(messages, t_ns)
        if sum(len(frame) == 2 for frame in frames.values()) < 2:
            continue
        n_seen += 1
        points = locate_wand(arena.truth.placed(), wand, frames)
        assert points is not None
        true = transform(arena.wand_pose(t_ns * 1e-9), wand.points)
        assert min(np.abs(points - true).max(), np.abs(points[::-1] - true).max()) < 5e-3
    assert n_seen > 10


def test_two_roundels_at_another_distance_are_no_wand():
    wand = Body(diameter_m=0.1, markers=((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)))
    arena = replace(ring(3), wand=wand)
    other = Body(diameter_m=0.1, markers=((0.0, 0.0, 0.0), (0.9, 0.0, 0.0)))
    messages = record(arena, 2.0, free_running=False)
    times = sorted({m.t_ns for m in messages})
    assert all(locate_wand(arena.truth.placed(), other, latest_frames(messages, t)) is None for t in times)


def test_nothing_is_located_without_two_placed_cameras():
    """Nor in frames of different times."""
    messages, cameras = record(ARENA, 1.0), ARENA.truth.placed()
    frames = latest_frames(messages, messages[-1].t_ns)
    assert locate_wand({}, ARENA.wand, frames) is None
    assert locate_wand(cameras, ARENA.wand, {}) is None
    name = sorted(cameras)[0]
    assert locate_wand({name: cameras[name]}, ARENA.wand, frames) is None
    old = {m.camera: m for m in reversed(messages) if m.camera != name} | {name: frames[name]}
    assert locate_wand(cameras, ARENA.wand, old) is None
