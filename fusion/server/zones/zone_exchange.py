# SPDX-License-Identifier: BSD-3-Clause
"""Connects a zone's server with those of the other zones: reports, states near borders, markers and status."""

import logging
from collections.abc import Callable, Mapping
from typing import TypeVar

from calib.rig.rig import Rig
from camera_node.protocol.messages import Keys, MessageError, decode
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import FusionStatus, Markers
from fusion.protocol.zone_messages import ZoneReport, ZoneStates, zone_key, zone_of
from fusion.server.arena_config import ArenaConfig
from fusion.server.ingest import MAX_AGE_NS
from fusion.server.pipeline import TrackingPipeline
from fusion.server.server_statistics import ServerStatistics
from fusion.server.transport import Transport
from fusion.server.zones.joined_messages import (
    join_markers,
    join_status,
    markers_of_zone,
    status_of_zone,
)
from fusion.server.zones.zone_member import ZoneMember
from fusion.tracking.track_table import TrackTable

Message = ZoneReport | ZoneStates | Markers | FusionStatus
T = TypeVar("T", bound=Message)

log = logging.getLogger("fusion")


class ZoneExchange:
    """What a zone's server sends to the other zones and receives from them.

    Args:
        config: the arena's, of a zone.
        keys: the arena's.
        pipeline: has the rig and the robots, and takes states.
        transport: publishes and subscribes.
        statistics: counts faults.

    Attributes:
        member: decides which robots and cameras are this zone's.
    """

    def __init__(
        self,
        config: ArenaConfig,
        keys: Keys,
        pipeline: TrackingPipeline,
        transport: Transport,
        statistics: ServerStatistics,
    ) -> None:
        assert config.zone is not None
        self.member = ZoneMember(config.arena, config.zones, config.zone)
        self._keys, self._pipeline, self._transport = keys, pipeline, transport
        self._statistics = statistics
        self._markers: dict[str, Markers] = {}  # the last ones of each other zone; of the first zone's server
        self._status: dict[str, FusionStatus] = {}
        self._known: tuple[Rig | None, Mapping[str, Robot]] = (None, {})
        self._on_other_cameras: Callable[[], object] = lambda: None

    def declare(self, on_other_cameras: Callable[[], object]) -> None:
        """Subscribe, and say that this server is there. `on_other_cameras` is called when it is to use other ones."""
        arena, name = self._keys.arena, self.member.name
        self._on_other_cameras = on_other_cameras
        self._transport.watch_tokens(zone_key(arena, "alive"), self._note_alive)
        self._subscribe("report", ZoneReport, self.member.ownership.receive)
        self._subscribe(f"states/{name}", ZoneStates, self._take_states)
        if self.member.leads:
            self._subscribe("markers", Markers, self._markers.__setitem__)
            self._subscribe("status", FusionStatus, self._status.__setitem__)
        self._transport.declare_alive(zone_key(arena, "alive", name))

    def _subscribe(self, content: str, kind: type[T], take: Callable[[str, T], object]) -> None:
        """Call `take(zone, message)` for each valid message of another zone."""

        def receive(data: bytes, key: str, received_ns: int) -> None:
            if (zone := zone_of(key)) not in self.member.others:
                return
            try:
                message = decode(data, kind)
                if abs(message.t_ns - received_ns) > MAX_AGE_NS:
                    raise MessageError("an implausible time")
            except MessageError:
                self._statistics.count_fault("unusable messages of zones")
            else:
                take(zone, message)

        self._transport.subscribe(zone_key(self._keys.arena, content), receive)

    def publish(self, now_ns: int) -> None:
        """Publish what the other zones need now; follow the rig."""
        rig, robots = self._pipeline.active_rig.rig, self._pipeline.robots
        if self._known[0] is not rig or self._known[1] is not robots:
            self._known = rig, robots
            if self.member.set_cameras(self._pipeline.cameras, robots):
                self._on_other_cameras()
        for key, message in self.member.messages(now_ns):
            self._transport.publish(key, message)

    def finish(self, table: TrackTable, markers: Markers) -> None:
        """Claim and hand over robots after a frame set, and publish its markers, in the first zone with the others'."""
        self.member.end(table, markers.t_ns)
        own = markers_of_zone(markers, self.member.own_cameras)
        if self.member.leads:
            self._transport.publish(self._keys.markers, join_markers(own, self._markers.values()))
        else:
            self._transport.publish(zone_key(self._keys.arena, "markers", self.member.name), own)

    def publish_status(self, status: FusionStatus) -> None:
        """Publish the status, in the first zone with the others'."""
        for zone in self.member.missing:
            self._statistics.count_fault(f"seconds without the server of zone {zone}")
        own = status_of_zone(status, self.member.own_cameras)
        if self.member.leads:
            joined = join_status(own, list(self._status.values()))
            self._transport.publish(self._keys.fusion_status, joined)
        else:
            self._transport.publish(zone_key(self._keys.arena, "status", self.member.name), own)

    def _note_alive(self, key: str, is_alive: bool) -> None:
        if (zone := zone_of(key)) not in self.member.others:
            return
        self.member.note_alive(zone, is_alive)
        if is_alive:
            log.info("the server of zone %s is there", zone)
        else:
            log.warning("the server of zone %s is away: neighbours take its robots and cameras", zone)
            self._markers.pop(zone, None)
            self._status.pop(zone, None)
        self._on_other_cameras()

    def _take_states(self, zone: str, states: ZoneStates) -> None:
        if self._pipeline.tracker is not None:
            self._pipeline.tracker.table.receive(zone, states)
