# SPDX-License-Identifier: BSD-3-Clause
"""The queries that the server answers: its time, the rig and the robots, and changes of both."""

import contextlib
import logging
from collections.abc import Callable
from functools import partial

import zenoh

from calib.rig.messages import (
    RigMessage,
    RigRequest,
    RigStepRequest,
    redo_rig_key,
    rig_history_key,
    set_rig_key,
    undo_rig_key,
)
from camera_node.foundation.rate_limit import RateLimit
from camera_node.node.clock_sync import ClockSync
from camera_node.protocol.messages import Keys, encode
from camera_node.protocol.requests import (
    RequestError,
    RequestSource,
    encode_reply,
    parse_request,
    payload_of,
)
from fusion.model.undistortion import prepare_lenses
from fusion.protocol.pose_messages import Robots, RobotsRequest, robots_key, set_robots_key
from fusion.server.pipeline import TrackingPipeline
from fusion.server.publisher import ArenaPublisher
from fusion.server.server_clock import ServerClock
from fusion.server.storage.audit import AuditLog
from fusion.server.transport import Transport

log = logging.getLogger("fusion")
RIG_ANSWERS_HZ = 20.0  # answers with the rig, of any number of clients


class RequestHandlers:
    """Answers the queries of an arena. Every shard answers for its robots, the leading one for the rig too.

    Args:
        keys: the arena's.
        pipeline: what requests read and change.
        publisher: publishes a changed rig.
        clock: the server's time.
        on_rig_change: called after each change of the rig.
    """

    def __init__(
        self,
        keys: Keys,
        pipeline: TrackingPipeline,
        publisher: ArenaPublisher,
        clock: ServerClock | ClockSync,
        on_rig_change: Callable[[], object],
    ) -> None:
        self._keys, self._pipeline, self._publisher = keys, pipeline, publisher
        self._clock, self._on_rig_change = clock, on_rig_change

    def declare(self, transport: Transport, audit: AuditLog) -> None:
        """Answer queries from now on; changes of robots are audited."""
        arena = self._keys.arena
        transport.answer_on_server_thread(robots_key(arena), self._answer_robots)
        change = audit.audited("change of robots", self._change_robots)
        transport.answer_on_server_thread(set_robots_key(arena), change)
        if isinstance(self._clock, ServerClock):
            transport.answer(self._keys.clock, partial(self._answer_clock, self._clock))

    def declare_rig(self, transport: Transport, audit: AuditLog) -> None:
        """Answer queries for the rig and its history, and audited ones for changes of it."""
        arena = self._keys.arena
        transport.answer(self._keys.rig, self._answer_rig, RateLimit(RIG_ANSWERS_HZ, RIG_ANSWERS_HZ))
        transport.answer_on_server_thread(rig_history_key(arena), self._answer_history)
        for key, change, answer, prepare in (
            (set_rig_key(arena), "change of the rig", self._set_rig, _prepare_lenses),
            (undo_rig_key(arena), "undo of the rig", self._undo_rig, self._prepare_step),
            (redo_rig_key(arena), "redo of the rig", self._redo_rig, self._prepare_step),
        ):
            transport.answer_on_server_thread(key, audit.audited(change, answer), prepare)

    def _answer_clock(self, clock: ServerClock, query: zenoh.Query) -> None:
        query.reply(self._keys.clock, encode(clock.reply()))

    def _answer_rig(self, query: zenoh.Query) -> None:
        if (message := self._pipeline.active_rig.message) is not None:
            query.reply(self._keys.rig, encode(message))

    def _answer_history(self, query: zenoh.Query) -> bytes:
        return encode_reply(payload_of(query), self._pipeline.active_rig.history())

    def _set_rig(self, query: zenoh.Query) -> bytes:
        request = parse_request(payload_of(query), RigRequest)
        self._pipeline.replace_rig(request.rig, self._clock.now_ns(), request.source)
        return self._announce_rig(query, "changed", request.source)

    def _undo_rig(self, query: zenoh.Query) -> bytes:
        request = _parse_step(query)
        self._pipeline.undo_rig(self._clock.now_ns(), request.source)
        return self._announce_rig(query, "set back to the previous one", request.source)

    def _redo_rig(self, query: zenoh.Query) -> bytes:
        request = _parse_step(query)
        self._pipeline.redo_rig(self._clock.now_ns(), request.source)
        return self._announce_rig(query, "set to the one that was undone", request.source)

    def _prepare_step(self, payload: bytes) -> None:
        for rig in self._pipeline.active_rig.neighbours():
            prepare_lenses(rig.placed().values())

    def _announce_rig(self, query: zenoh.Query, change: str, source: RequestSource | None) -> bytes:
        """Publish and log the rig in force; returns the reply to the request that changed it."""
        message = self._in_force()
        log.warning("the rig was %s by %s", change, source or "an unnamed program")
        self._on_rig_change()
        self._publisher.publish_rig(message)
        return encode_reply(payload_of(query), message)

    def _in_force(self) -> RigMessage:
        message = self._pipeline.active_rig.message
        assert message is not None
        return message

    def _answer_robots(self, query: zenoh.Query) -> bytes:
        payload = payload_of(query)
        if payload and parse_request(payload, RobotsRequest) != RobotsRequest():
            raise RequestError(f"send changes of robots to {set_robots_key(self._keys.arena)}")
        return self._robots_reply(payload)

    def _robots_reply(self, payload: bytes) -> bytes:
        robots = Robots(robots=self._pipeline.robots, unsaved=self._pipeline.unsaved_robots())
        return encode_reply(payload, robots)

    def _change_robots(self, query: zenoh.Query) -> bytes:
        payload = payload_of(query)
        request = parse_request(payload, RobotsRequest)
        self._publisher.stop_robots(self._pipeline.change_robots(request))
        return self._robots_reply(payload)


def _prepare_lenses(payload: bytes) -> None:
    with contextlib.suppress(RequestError):  # which the answer to the request reports
        prepare_lenses(parse_request(payload, RigRequest).rig.placed().values())


def _parse_step(query: zenoh.Query) -> RigStepRequest:
    payload = payload_of(query)
    return parse_request(payload, RigStepRequest) if payload else RigStepRequest()
