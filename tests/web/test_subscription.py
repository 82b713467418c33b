# SPDX-License-Identifier: BSD-3-Clause
"""What can be asked of a running arena is asked, and whoever does not answer is told."""

import numpy as np
import zenoh

from calib.rig.messages import RigMessage
from calib.rig.rig import Rig
from camera_node.protocol.messages import encode
from camera_node.protocol.session import open_client
from fusion.protocol.messages import undo_key
from tests.web.conftest import Played, four_cameras, wait_for
from web.feed import Feed
from web.subscription import Subscription


def test_a_late_joiner_gets_the_rig(played: Played):
    """A feed that starts after calibration asks for the rig as soon as it sees the server."""
    queryable = played.serve_rig(four_cameras())
    token = played.session.liveliness().declare_token(played.keys.fusion_alive)
    session = open_client([played.endpoint])
    late = Feed("test")
    subscription = Subscription(session, late)
    wait_for(lambda: played.status() or late.latest().rig)  # it asks again with every status
    rig = late.latest().rig
    assert rig is not None
    assert set(rig.placed()) == {"north", "east", "south", "west"}
    assert late.latest().server_alive
    token.undeclare()
    wait_for(lambda: not late.latest().server_alive)
    queryable.undeclare()
    subscription.close()
    session.close()


def test_snapshot_of_a_camera_that_is_away(subscription: Subscription):
    """Nobody answers: None, and soon."""
    assert subscription.snapshot("nowhere", timeout_s=0.2) is None


def test_snapshot_is_what_the_camera_sends(played: Played, subscription: Subscription):
    """The bytes of the queryable, unchanged."""
    key = played.keys.snapshot("north")
    data = np.arange(256, dtype=np.uint8).tobytes()
    queryable = played.session.declare_queryable(key, lambda query: query.reply(key, data))
    wait_for(lambda: subscription.snapshot("north", timeout_s=0.5) == data)
    queryable.undeclare()


def test_an_undo_tells_what_the_server_answers(played: Played, subscription: Subscription):
    """Its refusal in its own words; what it granted; and silence."""
    assert "no server" in subscription.undo(timeout_s=0.2)
    key = undo_key("test")
    message = encode(RigMessage.of(Rig(cameras={})))
    granted = [False]

    def answer(query: zenoh.Query) -> None:
        with query:
            if granted[0]:
                query.reply(key, message)
            else:
                query.reply_err("nothing to undo")

    queryable = played.session.declare_queryable(key, answer)
    wait_for(lambda: subscription.undo(timeout_s=0.5) == "nothing to undo")
    granted[0] = True
    assert subscription.undo(timeout_s=5.0) == "the camera is back where it stood"
    queryable.undeclare()
