# SPDX-License-Identifier: BSD-3-Clause
"""The wand is located in the latest frames of placed cameras."""

import numpy as np

from calib.live.wand_position import locate_wand
from calib.rig.camera import transform
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
