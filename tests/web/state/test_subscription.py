# SPDX-License-Identifier: BSD-3-Clause
"""The subscription requests the rig, snapshots and undo, and reports a missing answer."""

from itertools import count

import numpy as np
import pytest
import zenoh

from calib.rig.rig import Rig
from calib.rig.rig_messages import RigMessage, rig_step_key
from camera_node.foundation.errors import NetworkError, RoundelError
from camera_node.protocol.messages import encode
from camera_node.protocol.server_connection import ServerConnection
from fusion.client.robot_definition import find_stationary_markers
from tests.waiting import repeating, wait_for
from tests.web.arena import LiveArena, four_cameras
from web.state.feed import Feed
from web.state.subscription import Subscription


def test_a_late_subscriber_receives_the_rig(arena: LiveArena):
    """A feed that starts after the calibration requests the rig when it sees the server."""
    queryable = arena.serve_rig(four_cameras())
    token = arena.session.liveliness().declare_token(arena.keys.fusion_alive)
    connection = ServerConnection([arena.endpoint])
    late = Feed("test")
    subscription = Subscription(connection, late)
    wait_for(lambda: late.state().rig, arena.status)  # each status repeats the request
    rig = late.state().rig
    assert rig is not None
    assert set(rig.placed()) == {"north", "east", "south", "west"}
    assert late.state().server_alive
    token.undeclare()
    wait_for(lambda: not late.state().server_alive)
    queryable.undeclare()
    subscription.close()
    connection.close()


def test_why_an_absent_camera_sends_no_snapshot(subscription: Subscription):
    with pytest.raises(NetworkError, match=r"camera 'nowhere' does not answer within 0\.2 s; a Zenoh router"):
        subscription.snapshot("nowhere", timeout_s=0.2)


def test_a_snapshot_is_the_camera_s_answer(arena: LiveArena, subscription: Subscription):
    """The bytes of the queryable, unchanged."""
    key = arena.keys.snapshot("north")
    data = np.arange(256, dtype=np.uint8).tobytes()
    queryable = arena.session.declare_queryable(key, lambda query: query.reply(key, data))
    assert subscription.snapshot("north") == data
    queryable.undeclare()


def test_frame_sets_that_locate_nothing_do_not_hide_a_marker(arena: LiveArena, subscription: Subscription):
    """Of one message in ten: a busy machine fuses the frames of single cameras. Before, such a marker "moves or is not
    visible"."""
    sent = count()
    with repeating(
        lambda: arena.markers([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)][: 1 + (next(sent) % 10 == 0)]), 0.01
    ):
        messages = subscription.collect_markers(0.5)
    assert find_stationary_markers(messages).position == pytest.approx(np.array([[1, 0, 0]]))


def test_undo_returns_the_server_s_answer(arena: LiveArena, subscription: Subscription):
    """No answer, then a refusal in the server's words, then success."""
    with pytest.raises(NetworkError, match="no server"):
        subscription.step_rig("undo", timeout_s=0.2)
    key = rig_step_key("test", "undo")
    message = encode(RigMessage(t_ns=0, rig=Rig(cameras={})))
    granted = [False]

    def answer(query: zenoh.Query) -> None:
        with query:
            if granted[0]:
                query.reply(key, message)
            else:
                query.reply_err("nothing to undo")

    queryable = arena.session.declare_queryable(key, answer)
    wait_for(lambda: outcome(subscription) == "nothing to undo")
    granted[0] = True
    assert "undone on the server: the last change" in subscription.step_rig("undo", timeout_s=5.0)
    queryable.undeclare()


def outcome(subscription: Subscription) -> str:
    """The server's answer to an undo, or why there is none."""
    try:
        return subscription.step_rig("undo", timeout_s=0.5)
    except RoundelError as error:
        return str(error)
