# SPDX-License-Identifier: BSD-3-Clause
"""Connects a feed to a running arena over Zenoh, and sends requests to its programs."""

import contextlib
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import msgspec
import zenoh

from calib.live.rig_requests import request_rig_history, request_rig_message, step_rig
from calib.rig.file_history import Step
from calib.rig.rig_messages import RigHistory
from camera_node.foundation.errors import RoundelError
from camera_node.foundation.rate_limit import RateLimit
from camera_node.protocol.camera_requests import request_settings, request_snapshot
from camera_node.protocol.messages import MessageError, Settings, decode
from camera_node.protocol.presence import ALIVE
from camera_node.protocol.requests import REQUEST_S, RequestSource
from camera_node.protocol.server_connection import ServerConnection
from camera_node.protocol.session import guarded
from fusion.client.robot_definition import collect_markers
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import FusionStatus, Markers, Robots, RobotsRequest
from fusion.protocol.robot_requests import change_robots, reframe_robot, request_robots
from web.state.feed import Feed

RIG_REQUESTS_HZ = 1.0  # however many status messages arrive
# From one request for the declared robots to the next; their markers may change without a message.
ROBOTS_S = 5.0


class Subscription:
    """Subscribes a feed to all keys that it decodes, as soon as the connection is open.

    `close` ends the subscription; the connection stays open. A request raises NetworkError while no server answers.
    """

    def __init__(self, connection: ServerConnection, feed: Feed) -> None:
        self.connection, self.feed = connection, feed
        self._lock = threading.Lock()
        self._entities: list[Any] = []
        self._previews: zenoh.Subscriber | None = None
        self._watched, self._closed = False, False
        self._rig_requests = RateLimit(RIG_REQUESTS_HZ, 2.0)
        self._robots_requests = RateLimit(1 / ROBOTS_S, 2.0)
        connection.when_open(self._declare)

    @property
    def session(self) -> zenoh.Session:
        """The session, for requests. Raises NetworkError while no server answers."""
        return self.connection.session(REQUEST_S)

    def close(self) -> None:
        """End the subscription."""
        with self._lock:
            self._closed = True
            entities = [*self._entities, *([self._previews] if self._previews else [])]
            self._entities, self._previews = [], None
        for entity in entities:
            entity.undeclare()

    def watch_previews(self, watched: bool) -> None:
        """Subscribe to the cameras' small pictures or not: the cameras send them only while someone subscribes."""
        self._watched = watched
        self.connection.when_open(self._follow_previews)

    def change_settings(self, camera: str, wanted: Settings | None = None) -> Settings:
        """Change settings of a camera, or none, and return those in use; raises as `request_settings`."""
        return request_settings(self.session, self.feed.keys.arena, camera, wanted)

    def snapshot(self, camera: str, timeout_s: float = REQUEST_S) -> bytes:
        """A camera's current image as JPEG; raises as `request_snapshot`."""
        return request_snapshot(self.session, self.feed.keys.arena, camera, timeout_s=timeout_s)

    def collect_markers(self, seconds: float) -> list[Markers]:
        """Collect the server's messages with unlabeled markers; see `fusion.client.robot_definition`."""
        return collect_markers(self.session, self.feed.keys.arena, seconds)

    def define(self, name: str, robot: Robot) -> Robots:
        """Have the server track a new robot, and return all robots.

        Raises:
            FusionError: the server refuses, as it does where the name is in use.
            NetworkError: it does not answer.
        """
        return self.change_robots(RobotsRequest(define={name: robot}))

    def change_robots(self, request: RobotsRequest) -> Robots:
        """Have the server change its robots; returns all robots and raises as `define`."""
        request = msgspec.structs.replace(request, source=RequestSource.of("web"))
        return self._stored(change_robots(self.session, self.feed.keys.arena, request))

    def reframe_robot(self, name: str, change: Callable[[Robot], Robot]) -> Robots:
        """Have the server replace a robot by `change` of it; returns all robots and raises as `define`."""
        arena = self.feed.keys.arena
        return self._stored(reframe_robot(self.session, arena, name, change, "web"))

    def declared_robots(self) -> Robots:
        """All robots of the server. Raises NetworkError if it does not answer."""
        return request_robots(self.session, self.feed.keys.arena)

    def _stored(self, robots: Robots) -> Robots:
        self.feed.store_robots(robots)
        return robots

    def step_rig(self, step: Step, timeout_s: float = REQUEST_S) -> str:
        """Have the server undo the last change of its rig, or redo the one that was undone last.

        Returns:
            The outcome as text.

        Raises:
            RequestError: the server refuses, as it does where there is none.
            NetworkError: it does not answer.
        """
        history = self.feed.state().history or RigHistory()
        step_rig(self.session, self.feed.keys.arena, step, "web", timeout_s, history.rig_t_ns)
        return history.describe_step(step)

    def _declare(self, session: zenoh.Session) -> None:
        keys = self.feed.keys
        with self._lock:
            if self._closed:
                return
            self._entities = [self._subscribe(session, key_expr) for key_expr in self.feed.key_exprs]
            # The liveliness token may arrive before the rig's queryable exists, and a published rig may be dropped
            # under congestion: each status of another rig asks again.
            receive_status = guarded("a status", partial(self._request_new_rig, session))
            receive_token = guarded("a server's token", partial(self._server_changed, session))
            self._entities += [
                session.declare_subscriber(keys.fusion_status, receive_status),
                session.liveliness().declare_subscriber(ALIVE, receive_token, history=True),
            ]

    def _follow_previews(self, session: zenoh.Session) -> None:
        with self._lock:
            if self._watched and self._previews is None and not self._closed:
                self._previews = self._subscribe(session, self.feed.keys.preview())
            elif not self._watched and self._previews is not None:
                self._previews.undeclare()
                self._previews = None

    def _subscribe(self, session: zenoh.Session, key_expr: str) -> zenoh.Subscriber:
        def receive(sample: zenoh.Sample) -> None:
            self.feed.receive(key_expr, str(sample.key_expr), sample.payload.to_bytes())

        return session.declare_subscriber(key_expr, guarded("a message", receive))

    def _server_changed(self, session: zenoh.Session, sample: zenoh.Sample) -> None:
        alive, arena = sample.kind == zenoh.SampleKind.PUT, str(sample.key_expr).partition("/")[0]
        self.feed.note_arena(arena, alive)
        if alive and arena == self.feed.keys.arena:
            self._request_rig(session)

    def _request_new_rig(self, session: zenoh.Session, sample: zenoh.Sample) -> None:
        with contextlib.suppress(MessageError):
            t_ns = decode(sample.payload.to_bytes(), FusionStatus).rig_t_ns
            if t_ns is not None and self._is_new_rig(t_ns):
                self._request_rig(session)
            self._request_robots(session)

    def _is_new_rig(self, t_ns: int) -> bool:
        """Whether the feed lacks the rig in force since `t_ns`, or its history."""
        state = self.feed.state()
        return t_ns != state.rig_t_ns or state.history is None or state.history.rig_t_ns != t_ns

    def _request_rig(self, session: zenoh.Session) -> None:
        keys = self.feed.keys

        def request() -> None:
            if (data := request_rig_message(session, keys.arena)) is not None:
                self.feed.receive(keys.rig, keys.rig, data)
                self.feed.store_history(request_rig_history(session, keys.arena))

        _ask(self._rig_requests, "rig", request)

    def _request_robots(self, session: zenoh.Session) -> None:
        def request() -> None:
            self.feed.store_robots(request_robots(session, self.feed.keys.arena))

        _ask(self._robots_requests, "robots", request)


def _ask(limit: RateLimit, what: str, request: Callable[[], None]) -> None:
    """Request something in a thread, unless too often: Zenoh's thread, which calls this, must not wait for replies."""

    def ask(_: None) -> None:
        with contextlib.suppress(RoundelError):  # a later status asks again
            request()

    asking = guarded(f"a request for the {what}", ask)
    if limit.passes():
        threading.Thread(target=asking, args=[None], name=what, daemon=True).start()
