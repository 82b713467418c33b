# SPDX-License-Identifier: BSD-3-Clause
"""The queries that the server answers: its time, and the rig, the robots and the cameras with changes of them."""

import contextlib
import logging
from collections.abc import Callable
from functools import partial

import zenoh

from calib.rig.file_history import Step
from calib.rig.rig_messages import (
    RigMessage,
    RigRequest,
    RigStepRequest,
    rig_history_key,
    rig_step_key,
    set_rig_key,
)
from camera_node.foundation.logs import about
from camera_node.foundation.rate_limit import RateLimit
from camera_node.node.clock_sync import ClockSync
from camera_node.protocol.messages import Keys, encode
from camera_node.protocol.registration import (
    CameraAssignment,
    CameraChange,
    CameraRegistration,
    RegisteredCameras,
    assigned_key,
    change_key,
    register_key,
    registered_key,
)
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
from fusion.server.server_clock import ServerClock
from fusion.server.storage.audit import AuditLog
from fusion.server.storage.camera_registry import CameraRegistry
from fusion.server.transport import Transport

log = logging.getLogger("fusion")
camera_log = logging.getLogger("fusion.cameras")
RIG_ANSWERS_HZ = 20.0  # answers with the rig, of any number of clients
START_DELAY_NS = (
    3_000_000_000  # for the programs of all cameras to start, before the first frame of a recording
)
TOGETHER_NS = 60_000_000_000  # recordings that start within this time after the first one are shifted equally


class ArenaQueries:
    """Answers the queries of an arena: its time, rig and robots; the only server, or that of the first zone.

    Args:
        keys: the arena's.
        pipeline: what requests read and change.
        transport: receives the queries, and publishes a changed rig.
        clock: the server's time.
        on_rig_change: called after each change of the rig.
    """

    def __init__(
        self,
        keys: Keys,
        pipeline: TrackingPipeline,
        transport: Transport,
        clock: ServerClock | ClockSync,
        on_rig_change: Callable[[], object],
    ) -> None:
        self._keys, self._pipeline, self._transport = keys, pipeline, transport
        self._clock, self._on_rig_change = clock, on_rig_change

    def declare(self, audit: AuditLog) -> None:
        """Answer queries from now on; changes are audited."""
        arena, transport = self._keys.arena, self._transport
        transport.answer_on_server_thread(robots_key(arena), self._answer_robots)
        change = audit.audited("change of robots", self._change_robots)
        transport.answer_on_server_thread(set_robots_key(arena), change)
        if isinstance(self._clock, ServerClock):
            transport.answer(self._keys.clock, partial(self._answer_clock, self._clock))
        transport.answer(self._keys.rig, self._answer_rig, RateLimit(RIG_ANSWERS_HZ, RIG_ANSWERS_HZ))
        transport.answer_on_server_thread(rig_history_key(arena), self._answer_history)
        for key, change, answer, prepare in (
            (set_rig_key(arena), "change of the rig", self._set_rig, _prepare_lenses),
            (
                rig_step_key(arena, "undo"),
                "undo of the rig",
                partial(self._step_rig, "undo"),
                self._prepare_step,
            ),
            (
                rig_step_key(arena, "redo"),
                "redo of the rig",
                partial(self._step_rig, "redo"),
                self._prepare_step,
            ),
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

    def _step_rig(self, step: Step, query: zenoh.Query) -> bytes:
        request = self._parse_step(query)
        self._pipeline.step_rig(step, self._clock.now_ns(), request.source)
        change = "set back to the previous one" if step == "undo" else "set to the one that was undone"
        return self._announce_rig(query, change, request.source)

    def _parse_step(self, query: zenoh.Query) -> RigStepRequest:
        payload = payload_of(query)
        request = parse_request(payload, RigStepRequest) if payload else RigStepRequest()
        active = self._pipeline.active_rig
        if request.rig_t_ns in (None, active.message and active.message.t_ns):
            return request
        versions = active.history().versions
        newest = next((version.describe() for version in versions if version.state == "in force"), "")
        raise RequestError(
            f"nothing was done, because the rig has changed since it was shown: {newest}; look, and repeat"
        )

    def _prepare_step(self, payload: bytes) -> None:
        for rig in self._pipeline.active_rig.neighbours():
            prepare_lenses(rig.placed().values())

    def _announce_rig(self, query: zenoh.Query, change: str, source: RequestSource | None) -> bytes:
        """Publish and log the rig in force; returns the reply to the request that changed it."""
        message = self._in_force()
        log.warning("the rig was %s by %s", change, source or "an unnamed program")
        self._on_rig_change()
        self._transport.publish(self._keys.rig, message)
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
        robots = Robots(robots=self._pipeline.robots, unsaved=self._pipeline.active_robots.unsaved())
        return encode_reply(payload, robots)

    def _change_robots(self, query: zenoh.Query) -> bytes:
        payload = payload_of(query)
        request = parse_request(payload, RobotsRequest)
        before = self._pipeline.robots
        for name in self._pipeline.change_robots(request):
            self._transport.undeclare(self._keys.robot_pose(name))
        if (robots := self._pipeline.robots) is not before:
            changed = Robots(robots=robots, renamed=request.rename)
            self._transport.publish(robots_key(self._keys.arena), changed)
        return self._robots_reply(payload)


class CameraQueries:
    """Answers the queries about cameras; the only server, or that of the first zone.

    Args:
        keys: the arena's.
        registry: names and settings.
        pipeline: its rig is changed with a camera's name.
        transport: receives the queries, and publishes assignments and the changed rig.
        clock: the server's time.
        retire: called with a name that no camera has any more, or with one that a camera has again and False.
    """

    def __init__(
        self,
        keys: Keys,
        registry: CameraRegistry,
        pipeline: TrackingPipeline,
        transport: Transport,
        clock: ServerClock | ClockSync,
        retire: Callable[[str, bool], object],
    ) -> None:
        self._keys, self._registry, self._pipeline = keys, registry, pipeline
        self._retire = retire
        self._transport, self._clock = transport, clock
        self._shift_ns: int | None = None

    def declare(self, audit: AuditLog) -> None:
        """Answer queries from now on; changes are audited."""
        arena, transport = self._keys.arena, self._transport
        transport.answer_on_server_thread(registered_key(arena), self._list)
        transport.answer_on_server_thread(register_key(arena), self._register)
        transport.answer_on_server_thread(
            change_key(arena), audit.audited("change of a camera", self._change)
        )

    def _list(self, query: zenoh.Query) -> bytes:
        return encode_reply(payload_of(query), RegisteredCameras(cameras=self._registry.cameras()))

    def _register(self, query: zenoh.Query) -> bytes:
        request = parse_request(payload_of(query), CameraRegistration)
        is_new = all(camera.id != request.id for camera in self._registry.cameras().values())
        name = self._registry.register(request)
        verb = "is new" if is_new else "is here again"
        camera_log.info("camera %s %s: %s %s", name, verb, request.driver, request.source, extra=about(name))
        shift_ns = None if request.first_t_ns is None else self._shift(request.first_t_ns)
        return encode_reply(payload_of(query), self._assignment(name, shift_ns))

    def _change(self, query: zenoh.Query) -> bytes:
        request = parse_request(payload_of(query), CameraChange)
        before = self._registry.find(request.camera)
        if request.name and request.name != before:
            self._registry.require_free(request.name)
            self._rename_in_rig(before, request)
        after = self._registry.change(before, request)
        if request.forget or after != before:
            self._retire(before, True)
        if not request.forget:
            assignment = self._assignment(after)
            key = assigned_key(self._keys.arena, assignment.id)
            self._transport.publish(key, assignment)
            self._transport.undeclare(key)
        return encode_reply(payload_of(query), RegisteredCameras(cameras=self._registry.cameras()))

    def _rename_in_rig(self, before: str, request: CameraChange) -> None:
        """Give the camera's lens and pose in the rig in force its new name."""
        rig = self._pipeline.active_rig.rig
        if rig is None or before not in rig.cameras:
            return
        if request.name in rig.cameras:
            raise RequestError(
                f"the rig has another camera with the name {request.name}; choose another name"
            )
        self._pipeline.rename_camera(before, request.name, self._clock.now_ns(), request.source)
        if (message := self._pipeline.active_rig.message) is not None:
            self._transport.publish(self._keys.rig, message)

    def _assignment(self, name: str, shift_ns: int | None = None) -> CameraAssignment:
        camera = self._registry.cameras()[name]
        self._retire(name, False)
        return CameraAssignment(
            id=camera.id,
            name=name,
            settings=camera.settings,
            t_ns=self._clock.now_ns(),
            recording_shift_ns=shift_ns,
        )

    def _shift(self, first_t_ns: int) -> int:
        """What is added to the times of a recording: the same for all recordings that start together."""
        now_ns = self._clock.now_ns()
        shift_ns = self._shift_ns
        if shift_ns is None or not abs(shift_ns + first_t_ns - now_ns) <= TOGETHER_NS:
            shift_ns = self._shift_ns = now_ns + START_DELAY_NS - first_t_ns
        return shift_ns


def _prepare_lenses(payload: bytes) -> None:
    with contextlib.suppress(RequestError):  # which the answer to the request reports
        prepare_lenses(parse_request(payload, RigRequest).rig.placed().values())
