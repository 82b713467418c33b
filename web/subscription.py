# SPDX-License-Identifier: BSD-3-Clause
"""A running arena over Zenoh: its messages to a feed, and what may be asked of its programs."""

from typing import Any

import zenoh

from camera_node.errors import RoundelError
from fusion.client.measure import collect_markers
from fusion.model.robots import Robot
from fusion.protocol.messages import Markers, RobotsRequest
from fusion.protocol.requests import change_robots, undo_correction
from web.feed import Feed

ASK_S = 2.0


class Subscription:
    """All that a feed understands, and the rig in force for whoever joins late; the session stays open."""

    def __init__(self, session: zenoh.Session, feed: Feed) -> None:
        self.session, self.feed = session, feed
        keys = feed.keys
        self._entities: list[Any] = [self._subscribe(key_expr) for key_expr in feed.key_exprs]
        self._entities += [
            # the server may be known before its queryable is: every status asks again while there is no rig
            session.declare_subscriber(keys.fusion_status, lambda _: self._want_rig()),
            session.liveliness().declare_subscriber(keys.fusion_alive, self._server_changed, history=True),
        ]

    def close(self) -> None:
        """Stop listening."""
        for entity in self._entities:
            entity.undeclare()

    def snapshot(self, camera: str, timeout_s: float = ASK_S) -> bytes | None:
        """The JPEG that a camera sees now, or None where it does not answer in time."""
        replies = self.session.get(self.feed.keys.snapshot(camera), timeout=timeout_s)
        return next((reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None), None)

    def watch(self, seconds: float) -> list[Markers]:
        """What the server tells of markers in so many seconds; FusionError where that is nothing."""
        return collect_markers(self.session, self.feed.keys.arena, seconds)

    def define(self, name: str, robot: Robot) -> None:
        """Have the server look for a robot; FusionError or NetworkError where it does not."""
        change_robots(self.session, self.feed.keys.arena, RobotsRequest(define={name: robot}), ASK_S)

    def undo(self, timeout_s: float = ASK_S) -> str:
        """Have the server take back the last pose that it found of a moved camera; what came of it, in words."""
        try:
            undo_correction(self.session, self.feed.keys.arena, timeout_s)
        except RoundelError as error:
            return str(error)
        return "the camera is back where it stood"

    def _subscribe(self, key_expr: str) -> zenoh.Subscriber:
        def take(sample: zenoh.Sample) -> None:
            self.feed.receive(key_expr, str(sample.key_expr), sample.payload.to_bytes())

        return self.session.declare_subscriber(key_expr, take)

    def _server_changed(self, sample: zenoh.Sample) -> None:
        alive = sample.kind == zenoh.SampleKind.PUT
        self.feed.server_changed(alive)
        if alive:
            self._ask_rig()

    def _want_rig(self) -> None:
        if self.feed.latest().rig is None:
            self._ask_rig()

    def _ask_rig(self) -> None:
        key = self.feed.keys.rig

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self.feed.receive(key, key, reply.ok.payload.to_bytes())

        self.session.get(key, take, timeout=5.0)
