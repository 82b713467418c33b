# SPDX-License-Identifier: BSD-3-Clause
"""Without certificates any client may answer the server's queries: programs prefer the answer of the server itself."""

import threading
import time
from contextlib import ExitStack
from pathlib import Path

import zenoh

from calib.live.rig_requests import request_rig
from calib.rig.rig import Rig
from calib.rig.rig_messages import RigMessage
from camera_node.node.clock_sync import ClockSync
from camera_node.protocol.messages import ClockReply, encode
from camera_node.protocol.server_connection import ServerConnection
from camera_node.protocol.session import listening_endpoints, open_client, open_router
from fusion.client.arena import Arena
from fusion.protocol.pose_messages import Robots, robots_key
from fusion.protocol.robot_requests import request_robots
from tests.fusion.serving import KEYS, config, serving
from tests.waiting import DEADLINE_S, wait_for
from tests.web.arena import four_cameras
from web.state.feed import Feed
from web.state.subscription import Subscription

AHEAD_NS = 100_000_000
ANY_PORT = ["tcp/127.0.0.1:0"]


def wait_for_answers(session: zenoh.Session, key: str, number: int) -> None:
    """Wait until a session knows that many queryables."""

    def answers() -> int:
        target, consolidation = zenoh.QueryTarget.ALL, zenoh.ConsolidationMode.NONE
        return len(list(session.get(key, target=target, consolidation=consolidation, timeout=5.0)))

    wait_for(lambda: answers() == number)


def test_a_false_time_that_comes_first_does_not_move_a_camera_s_clock():
    """The server answers each request after a client that is 0.1 s ahead. All share one clock: the offset is 0."""
    spoofed = threading.Semaphore(0)

    def answer_late(query: zenoh.Query) -> None:
        with query:
            spoofed.acquire(timeout=DEADLINE_S)
            query.reply(query.key_expr, encode(ClockReply(time.time_ns())))

    def answer_falsely(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, encode(ClockReply(time.time_ns() + AHEAD_NS)))
        spoofed.release()

    with ExitStack() as stack:
        server = stack.enter_context(open_router(ANY_PORT))
        endpoints = listening_endpoints(server, ANY_PORT)
        spoofer, camera = (stack.enter_context(open_client(endpoints)) for _ in range(2))
        spoofer.declare_queryable(KEYS.clock, answer_falsely)
        wait_for_answers(camera, KEYS.clock, 1)  # each request that reaches the server has a false answer
        server.declare_queryable(
            KEYS.clock, lambda query: threading.Thread(target=answer_late, args=[query]).start()
        )
        wait_for_answers(camera, KEYS.clock, 2)
        while spoofed.acquire(blocking=False):  # of requests that did not reach the server
            pass
        clock = ClockSync(camera, KEYS).start()
        stack.callback(clock.close)
        wait_for(clock.estimate)
        offset_ns, error_ns = clock.estimate() or (AHEAD_NS, 0.0)
        assert abs(offset_ns) <= error_ns < AHEAD_NS


def test_false_robots_are_not_believed(tmp_path: Path):
    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, encode(Robots(robots={})))

    with serving(config(tmp_path)) as (server, _), ExitStack() as stack:
        spoofer, session = (stack.enter_context(open_client(server.endpoints)) for _ in range(2))
        spoofer.declare_queryable(robots_key(KEYS.arena), answer, complete=True)
        wait_for_answers(session, robots_key(KEYS.arena), 2)
        assert set(request_robots(session, KEYS.arena).robots) == {"a"}


def test_a_false_rig_is_not_believed(tmp_path: Path):
    """Neither by programs that ask for the rig nor by the page nor by clients."""
    false = RigMessage(t_ns=1, rig=Rig(cameras={"false": next(iter(four_cameras().cameras.values()))}))

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, encode(false))

    with serving(config(tmp_path)) as (server, _), ExitStack() as stack:
        spoofer, session = (stack.enter_context(open_client(server.endpoints)) for _ in range(2))
        spoofer.declare_queryable(KEYS.rig, answer, complete=True)
        wait_for_answers(session, KEYS.rig, 2)
        rig = request_rig(session, KEYS.arena)
        assert rig is not None
        assert "false" not in rig.cameras
        connection = stack.enter_context(ServerConnection(server.endpoints))
        subscription = Subscription(connection, Feed(KEYS.arena))
        stack.callback(subscription.close)
        wait_for(lambda: subscription.feed.state().rig)
        assert subscription.feed.state().rig == rig
        client = stack.enter_context(Arena.connect(*server.endpoints, arena=KEYS.arena))
        wait_for_answers(client.session, KEYS.rig, 2)
        assert client.rig() == rig
