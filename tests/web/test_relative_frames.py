# SPDX-License-Identifier: BSD-3-Clause
"""Roundels that cameras locate by themselves are drawn where the cameras are, in a rig or in the demo."""

import numpy as np
import pytest

from calib.rig.camera import transform
from camera_node.geometry.pose import Pose, rotation_from_wxyz, rotation_with_z
from camera_node.protocol.messages import encode
from tests.camera_node.protocol.positions import pack_random
from tests.waiting import wait_for
from tests.web.arena import LiveArena, four_cameras
from tests.web.browser import loopback
from web.scene.markers import located_frames
from web.state.feed import DemoProgress, Feed, progress_key
from web.view import View

MOVING = Pose((1.0, 2.0, 0.2), (0.5, -0.5, 0.5, -0.5))


def test_frames_are_drawn_at_placed_and_moving_cameras(arena: LiveArena, feed: Feed):
    """As many as the messages have, however the number changes; those of a camera without a pose are left out."""
    view, rig = View(feed, loopback()), four_cameras()
    arena.rig(rig)
    progress = DemoProgress(t_ns=0, text="", share=0.5, true_cameras={"scout": MOVING})
    poses = {"north": rig.placed()["north"].matrix(), "scout": MOVING.matrix()}
    for counts in ({"north": 2, "scout": 1, "lost": 3}, {"north": 1, "scout": 3, "lost": 1}):
        messages = {name: pack_random(n, name) for name, n in counts.items()}

        def send(messages=messages) -> None:
            arena.put(progress_key("test"), encode(progress))
            for name, message in messages.items():
                arena.put(arena.keys.relative(name), encode(message))

        def arrived(messages=messages) -> bool:
            state = feed.state()
            same = [state.relative[n].message == m for n, m in messages.items() if n in state.relative]
            return state.rig is not None and len(same) == 3 and all(same) and len(located_frames(state)) > 0

        wait_for(arrived, send)
        frames = located_frames(feed.state())
        seen = {name: messages[name].unpack() for name in poses}
        expected = [transform(poses[name], seen[name].position) for name in messages if name in poses]
        assert sorted(frames[:, :3, 3].tolist()) == pytest.approx(
            np.array(sorted(np.concatenate(expected).tolist()))
        )
        view.update()
    assert not feed.state().faults
    view.close()


def test_the_frame_of_a_normal_is_a_rotation():
    z = np.random.default_rng(1).normal(size=(50, 3))
    z = np.concatenate([z / np.linalg.norm(z, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    R = rotation_with_z(z)
    assert np.allclose(R @ R.mT, np.eye(3))
    assert np.allclose(np.linalg.det(R), 1)
    assert np.allclose(R[:, :, 2], z)
    assert np.allclose(rotation_from_wxyz(MOVING.wxyz), MOVING.matrix()[:3, :3])
