# SPDX-License-Identifier: BSD-3-Clause
"""One server's part in an arena with zones: which robots it publishes, which cameras it uses, what it tells the others.

Reads no clock and no network.
"""

from collections.abc import Iterator, Mapping, Sequence

import msgspec
import numpy as np

from calib.rig.camera import Camera
from camera_node.foundation.arrays import Index
from fusion.model.robots import Robot
from fusion.protocol.zone_messages import ZoneStates, zone_key
from fusion.server.arena_config import Zone
from fusion.server.zones.ownership import Ownership
from fusion.server.zones.zone_cameras import SeenPlaces, ZoneCameras
from fusion.tracking.track_table import TrackTable

EXCHANGE_NS = (
    100_000_000  # between two reports: at 2 m/s a robot moves by 0.2 m, a tenth of what two cameras share
)
FULL_NS = 1_000_000_000  # between two reports of all robots, which repair what was lost
# A robot is handed over to a zone whose cameras determine it with at most half the variance, as twice as many cameras
# do: a robot that moves about a border stays with its owner.
HYSTERESIS = 2.0


class ZoneMember:
    """The server of one zone.

    Args:
        arena: the arena's name.
        zones: all zones of the arena.
        name: of this server's zone.

    Attributes:
        name: as given.
        leads: whether it is the first zone, which has the arena's clock, rig, robots, cameras and status.
        ownership: of the robots.
        own_cameras, used_cameras: names of the zone's own cameras, with those adopted of dead zones, and of those that
            it subscribes to.
    """

    def __init__(self, arena: str, zones: Sequence[Zone], name: str) -> None:
        self.name, self.leads = name, zones[0].name == name
        self.ownership = Ownership(name)
        self._arena, self._zones = arena, {zone.name: zone.cameras for zone in zones}
        self.own_cameras = self.used_cameras = set(self._zones[name])
        self._scene: tuple[dict[str, Camera], float] = ({}, 0.0)
        self._cameras = ZoneCameras(*self._scene[:1], self._zones, 0.0)
        self._own: dict[str, set[str]] = {}
        self._used: dict[str, set[str]] = {}  # of the other living zones
        self._weighed_ns = self._reported_ns = self._repaired_ns = 0
        self._has_news = False
        self._states: list[tuple[str, ZoneStates]] = []

    @property
    def missing(self) -> list[str]:
        """The other zones whose servers are not there."""
        return [zone for zone in self.others if zone not in self.ownership.others]

    def set_cameras(self, cameras: dict[str, Camera], robots: Mapping[str, Robot]) -> bool:
        """Use a rig's placed cameras for these robots; return whether that changes anything."""
        diameter_m = max((robot.diameter_m for robot in robots.values()), default=0.0)
        if (cameras, diameter_m) == self._scene:
            return False
        self._scene = cameras, diameter_m
        self._cameras = ZoneCameras(cameras, self._zones, diameter_m)
        self._divide()
        return True

    @property
    def others(self) -> list[str]:
        """All other zones."""
        return [zone for zone in self._zones if zone != self.name]

    def note_alive(self, zone: str, is_alive: bool) -> None:
        """Take note that another zone's server is there, or not any more; others use its cameras then."""
        self.ownership.note_alive(zone, is_alive)
        self._divide()
        self._reported_ns = self._repaired_ns = 0  # it has heard nothing yet

    def begin(self, table: TrackTable, t_ns: int) -> None:
        """Tell a table which robots this zone publishes in the frame set of `t_ns`, and searches for."""
        table.owned[:] = [self.ownership.publishes(name, t_ns) for name in table.names]
        table.searched[:] = [self.ownership.searches(name) for name in table.names]

    def end(self, table: TrackTable, t_ns: int) -> None:
        """Claim and hand over robots after a frame set."""
        tracked = [table.names[k] for k in np.flatnonzero(table.tracked).tolist()]
        lost = [table.names[k] for k in np.flatnonzero(~table.alive).tolist()]
        is_due, better = t_ns - self._weighed_ns >= EXCHANGE_NS, {}
        if is_due:
            own = np.flatnonzero(table.owned & table.alive)
            seen = self._cameras.look_at(table.states.p[own])
            better = self._find_better(table, own, seen)
            self._weighed_ns, self._states = t_ns, list(self._border_states(table, own, seen, t_ns))
        self._has_news |= self.ownership.step(t_ns, tracked, lost, better)

    def messages(self, now_ns: int) -> Iterator[tuple[str, msgspec.Struct]]:
        """What is to be published now, and its keys."""
        if self._has_news or not 0 <= now_ns - self._reported_ns < EXCHANGE_NS:
            is_full = not 0 <= now_ns - self._repaired_ns < FULL_NS
            yield zone_key(self._arena, "report", self.name), self.ownership.report(now_ns, is_full)
            self._has_news, self._reported_ns = False, now_ns
            self._repaired_ns = now_ns if is_full else self._repaired_ns
        for zone, states in self._states:
            yield zone_key(self._arena, f"states/{zone}", self.name), states
        self._states = []

    def _divide(self) -> None:
        """Divide the cameras between the zones that live."""
        living = {self.name, *self.ownership.others}
        self._own = self._cameras.own(living)
        self._used = {zone: self._cameras.used(own) for zone, own in self._own.items()}
        self.own_cameras, self.used_cameras = self._own[self.name], self._used.pop(self.name)

    def _find_better(self, table: TrackTable, own: Index, seen: SeenPlaces) -> dict[str, str]:
        """The follower whose own cameras determine a robot best, of own robots of which that is not this zone."""
        followers = [self.ownership.followers(table.names[k]) for k in own.tolist()]
        limit = np.where(
            table.tracked[own], seen.variances(self._own.get(self.name, ())) / HYSTERESIS, np.inf
        )
        better: dict[str, str] = {}
        for zone in sorted({zone for zones in followers for zone in zones}):
            variance = seen.variances(self._own.get(zone, ()))
            for i, k in enumerate(own.tolist()):
                if zone in followers[i] and variance[i] < limit[i]:
                    better[table.names[k]], limit[i] = zone, variance[i]
        return better

    def _border_states(
        self, table: TrackTable, own: Index, seen: SeenPlaces, t_ns: int
    ) -> Iterator[tuple[str, ZoneStates]]:
        """For each other zone the states of the own robots that its cameras may see."""
        tracked = table.tracked[own]
        for zone, cameras in self._used.items():
            rows = own[tracked & seen.by(cameras)]
            if len(rows):
                yield zone, ZoneStates.of(t_ns, table.names, table.states, rows)
