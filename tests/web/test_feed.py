# SPDX-License-Identifier: BSD-3-Clause
"""The feed keeps the latest of everything, asks for the rig when it joins late, and survives any bytes."""

import pytest

from camera_node.protocol.messages import encode
from tests.web.conftest import Played, wait_for
from web.feed import MAX_REASONS, Feed
from web.messages import DemoProgress, progress_key


def test_what_is_published_is_kept(played: Played, feed: Feed):
    """Poses, cameras, status and coverage arrive as they were sent."""
    played.pose("rover", (0.5, -0.25, 0.125))
    played.camera("north")
    played.status()
    played.detections("north", [(100.0, 100.0), (500.0, 400.0)])
    wait_for(lambda: (x := feed.latest()).poses and x.cameras and x.status and x.coverage)
    latest = feed.latest()
    assert latest.poses["rover"].message.position == (0.5, -0.25, 0.125)
    assert latest.cameras["north"].message.dropped == 2
    assert latest.status is not None
    assert latest.status.message.cameras["north"].assigned == 200
    assert latest.coverage["north"].share == 2 / 64
    assert latest.received["frames north"] == 1
    assert not latest.faults


@pytest.mark.parametrize("data", [b"", b"\xc1", b"not a message", b"\x81\xa1a" * 50, bytes(1000)])
def test_bytes_that_are_no_message_are_counted(played: Played, feed: Feed, data: bytes):
    """On every key: one fault each, nothing kept, and what comes next is still heard."""
    keys = played.keys
    all_keys = [
        keys.robot_pose("rover"),
        keys.markers,
        keys.fusion_status,
        keys.camera_status("north"),
        keys.detections("north"),
        keys.rig,
        progress_key("test"),
    ]
    for key in all_keys:
        played.put(key, data)
    wait_for(lambda: feed.latest().faults.total() == len(all_keys))
    latest = feed.latest()
    assert not latest.poses
    assert latest.rig is None
    played.pose("rover", (0, 0, 0))
    wait_for(lambda: feed.latest().poses)


def test_a_pose_that_can_not_be_drawn_is_counted(played: Played, feed: Feed):
    """Far beyond any arena, under another robot's key, or another kind of message."""
    played.pose("rover", (1e300, 0.0, 0.0))
    played.pose("drone", (0.0, 0.0, 0.0), key="rover")
    played.put(played.keys.robot_pose("rover"), encode(DemoProgress(t_ns=0, text="", share=0.5)))
    wait_for(lambda: feed.latest().faults.total() == 3)
    assert not feed.latest().poses


def test_a_rig_that_is_none_is_counted(played: Played, feed: Feed):
    """Valid MessagePack around text that is no rig."""
    from calib.rig.messages import RigMessage

    for text in ("cameras: [", "cameras: 3", "&a [*a]", "!!python/object:os.system {}"):
        played.put(played.keys.rig, encode(RigMessage(t_ns=0, yaml=text)))
    wait_for(lambda: feed.latest().faults.total() == 4)
    assert feed.latest().rig is None


def test_faults_do_not_fill_the_memory(feed: Feed):
    """Reasons that never repeat end up as one."""
    for k in range(10 * MAX_REASONS):
        feed.count_fault(f"reason {k}")
    faults = feed.latest().faults
    assert len(faults) == MAX_REASONS + 1
    assert faults.total() == 10 * MAX_REASONS


def test_latest_is_a_copy(played: Played, feed: Feed):
    """What was read stays as it was."""
    before = feed.latest()
    played.pose("rover", (0, 0, 0))
    wait_for(lambda: feed.latest().poses)
    assert not before.poses
