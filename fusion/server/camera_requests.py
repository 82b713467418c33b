# SPDX-License-Identifier: BSD-3-Clause
"""The queries by which cameras get their names, and by which users change names and settings."""

import logging
from collections.abc import Callable

import msgspec
import zenoh

from camera_node.foundation.logs import about
from camera_node.node.clock_sync import ClockSync
from camera_node.protocol.registration import (
    CameraAssignment,
    CameraChange,
    CameraRegistration,
    RegisteredCameras,
    change_key,
    register_key,
    registered_key,
)
from camera_node.protocol.requests import RequestError, encode_reply, parse_request, payload_of
from fusion.server.pipeline import TrackingPipeline
from fusion.server.publisher import ArenaPublisher
from fusion.server.server_clock import ServerClock
from fusion.server.storage.audit import AuditLog
from fusion.server.storage.camera_registry import CameraRegistry
from fusion.server.transport import Transport

log = logging.getLogger("fusion.cameras")
START_DELAY_NS = (
    3_000_000_000  # for the programs of all cameras to start, before the first frame of a recording
)
TOGETHER_NS = 60_000_000_000  # recordings that start within this time after the first one are shifted equally


class CameraRequests:
    """Answers the queries about cameras; the leading shard only.

    Args:
        arena: its name.
        registry: names and settings.
        pipeline: its rig is changed with a camera's name.
        publisher: publishes assignments and the changed rig.
        clock: the server's time.
        on_retired: called with the name of a camera that no camera has any more.
    """

    def __init__(
        self,
        arena: str,
        registry: CameraRegistry,
        pipeline: TrackingPipeline,
        publisher: ArenaPublisher,
        clock: ServerClock | ClockSync,
        on_retired: Callable[[str], object],
    ) -> None:
        self._arena, self._registry, self._pipeline = arena, registry, pipeline
        self._on_retired = on_retired
        self._publisher, self._clock = publisher, clock
        self._shift_ns: int | None = None

    def declare(self, transport: Transport, audit: AuditLog) -> None:
        """Answer queries from now on; changes are audited."""
        arena = self._arena
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
        log.info("camera %s %s: %s %s", name, verb, request.driver, request.source, extra=about(name))
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
            self._on_retired(before)
        if not request.forget:
            self._publisher.publish_assignment(self._assignment(after))
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
        cameras = {request.name if name == before else name: entry for name, entry in rig.cameras.items()}
        renamed = msgspec.structs.replace(rig, cameras=cameras)
        self._pipeline.replace_rig(renamed, self._clock.now_ns(), request.source)
        if (message := self._pipeline.active_rig.message) is not None:
            self._publisher.publish_rig(message)

    def _assignment(self, name: str, shift_ns: int | None = None) -> CameraAssignment:
        camera = self._registry.cameras()[name]
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
