# SPDX-License-Identifier: BSD-3-Clause
"""The feed stores the latest message of each kind and counts invalid ones."""

import pytest

from camera_node.protocol.messages import encode
from tests.calib.rig.hostile import as_publication, hostile_messages
from tests.waiting import wait_for
from tests.web.arena import ArenaMessages, LiveArena, four_cameras
from web.state.feed import MAX_PENDING, MAX_REASONS, REMOVED_CAMERA_S, DemoProgress, Feed, progress_key
from web.state.subscription import Subscription

pytestmark = pytest.mark.computed


def test_messages_are_stored(arena: LiveArena, feed: Feed):
    """Poses, camera status, server status and coverage arrive as they were sent."""
    arena.pose("rover", (0.5, -0.25, 0.125))
    arena.camera("north")
    arena.status()
    arena.detections("north", [(100.0, 100.0), (500.0, 400.0)])
    wait_for(lambda: (x := feed.state()).poses and x.cameras and x.status and x.coverage)
    state = feed.state()
    assert state.poses["rover"].message.position == (0.5, -0.25, 0.125)
    assert state.cameras["north"].message.dropped == 2
    assert state.status is not None
    assert state.status.message.cameras["north"].assigned == 200
    assert state.coverage["north"].share() == 2 / 48
    assert state.message_counts["frames north"] == 1
    assert not state.faults


@pytest.mark.parametrize("data", [b"", b"\xc1", b"not a message", b"\x81\xa1a" * 50, bytes(1000)])
def test_invalid_bytes_are_counted(arena: LiveArena, feed: Feed, data: bytes):
    """Each key counts one fault and stores nothing; later messages are received."""
    keys = arena.keys
    all_keys = [
        keys.robot_pose("rover"),
        keys.markers,
        keys.fusion_status,
        keys.camera_status("north"),
        keys.detections("north"),
        keys.relative("north"),
        keys.rig,
        progress_key("test"),
    ]
    for key in all_keys:
        arena.put(key, data)
    wait_for(lambda: feed.state().faults.total() == len(all_keys))
    state = feed.state()
    assert not state.poses
    assert state.rig is None
    arena.pose("rover", (0, 0, 0))
    wait_for(lambda: feed.state().poses)


def test_an_invalid_pose_is_counted(arena: LiveArena, feed: Feed):
    """A position beyond any arena, a pose under another robot's key, and another kind of message."""
    for k, send in enumerate(
        (
            lambda: arena.pose("rover", (1e300, 0.0, 0.0)),
            lambda: arena.pose("drone", (0.0, 0.0, 0.0), key="rover"),
            lambda: arena.put(
                arena.keys.robot_pose("rover"), encode(DemoProgress(t_ns=0, text="", share=0.5))
            ),
        )
    ):
        send()  # the next one would supersede it before it is decoded
        wait_for(lambda k=k: feed.state().faults.total() == k + 1)
    assert not feed.state().poses


def test_only_the_latest_pose_is_decoded():
    """When the state is read, with its time of arrival; with a callback each pose is decoded when it arrives."""
    now, got = [0.0], []
    arena = Recorded()
    for x in (1.0, 2.0, 3.0):
        arena.pose("rover", (x, 0.0, 0.0))
    feeds = [Feed("test", clock=lambda: now[0]), Feed("test", got.append, clock=lambda: now[0])]
    for feed in feeds:
        for key, data in arena.messages:
            now[0] += 1.0
            feed.receive(feed.keys.robot_pose(), key, data)
    lazy, eager = (feed.state() for feed in feeds)
    assert lazy.poses["rover"].message.position[0] == eager.poses["rover"].message.position[0] == 3.0
    assert (lazy.poses["rover"].received_s, eager.poses["rover"].received_s) == (3.0, 6.0)
    assert (lazy.message_counts["RobotPose"], eager.message_counts["RobotPose"]) == (1, 3)
    assert [pose.position[0] for pose in got] == [1.0, 2.0, 3.0]


def test_the_number_of_undecoded_messages_is_limited():
    """A sender of ever new keys is counted."""
    arena, feed = Recorded(), Feed("test")
    arena.pose("rover", (0.0, 0.0, 0.0))
    for k in range(MAX_PENDING + 10):
        feed.receive(feed.keys.robot_pose(), feed.keys.robot_pose(f"r{k}"), arena.messages[0][1])
    faults = feed.state().faults
    assert faults[f"more than {MAX_PENDING} keys"] == 10
    assert faults.total() == MAX_PENDING + 10, "the names in the others differ from their keys"


class Recorded(ArenaMessages):
    """Stores the messages."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, bytes]] = []

    def put(self, key: str, data: bytes) -> None:
        self.messages.append((key, data))


def test_an_invalid_rig_is_counted(arena: LiveArena, feed: Feed):
    """None of the hostile messages has another effect."""
    for data in hostile_messages(four_cameras()).values():
        before, message = feed.state().faults.total(), as_publication(data)
        wait_for(
            lambda before=before: feed.state().faults.total() > before,
            lambda message=message: arena.put(arena.keys.rig, message),
        )
    assert feed.state().rig is None


def test_the_number_of_fault_reasons_is_limited(feed: Feed):
    """Reasons that never repeat are counted together."""
    for k in range(10 * MAX_REASONS):
        feed.count_fault(f"reason {k}")
    faults = feed.state().faults
    assert len(faults) == MAX_REASONS + 1
    assert faults.total() == 10 * MAX_REASONS


def test_the_state_is_a_copy(arena: LiveArena, feed: Feed):
    """A later message does not change a state that was read before."""
    before = feed.state()
    arena.pose("rover", (0, 0, 0))
    wait_for(lambda: feed.state().poses)
    assert not before.poses


def test_a_renamed_camera_disappears(arena: LiveArena, subscription: Subscription):
    """A camera that is silent and that the server does not list has another name; one that it lists is silent only."""
    feed, now = subscription.feed, [0.0]
    feed._clock = lambda: now[0]
    wait_for(lambda: {"old", "pulled"} <= feed.state().cameras.keys(), lambda: _announce(arena))
    now[0] = REMOVED_CAMERA_S - 1.0
    arena.status(cameras=("pulled",))
    wait_for(lambda: feed.state().status)
    assert "old" in feed.state().cameras, "the server may not know it yet"
    now[0] = REMOVED_CAMERA_S + 1.0
    wait_for(lambda: "old" not in feed.state().cameras, lambda: arena.status(cameras=("pulled",)))
    assert "pulled" in feed.state().cameras


def _announce(arena: LiveArena) -> None:
    arena.camera("old")
    arena.camera("pulled")
