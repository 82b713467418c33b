# SPDX-License-Identifier: BSD-3-Clause
"""Owners of robots in virtual time: one after any faults, and poses without a gap or a double at a crossing."""

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count, pairwise

import numpy as np
import pytest

from camera_node.protocol.messages import MessageError, decode, encode
from fusion.protocol.zone_messages import Claim, ZoneReport
from fusion.server.zones.ownership import Ownership

PERIOD_NS = 16_666_667
LATENCY_NS = 2_000_000
STEPS = 200  # of what zones see at random
START_NS = 4 * 10**9  # until all robots have owners
EXCHANGE = 6  # frame sets between two reports, as of a server at 60 Hz
Sees = Callable[[str, str, int], bool]
Better = Callable[[str, str, int], str | None]


@dataclass(eq=False)
class Zone:
    """A server: its ownership, and the poses that it published."""

    name: str
    phase_ns: int
    ownership: Ownership
    published: list[tuple[int, str]] = field(default_factory=list)
    n: int = 0


class Hall:
    """Zones whose messages and frame sets happen in the order of a virtual time.

    `sees(zone, robot, t_ns)` tells what a zone's cameras see, `better` which zone sees a robot best. `deliver` returns
    the delay of a message, or None if it is lost.
    """

    def __init__(self, names: str, sees: Sees, better: Better, deliver: Callable[[], list[int]]) -> None:
        self.sees, self.better, self.deliver = sees, better, deliver
        self.robots = [f"robot{k}" for k in range(5)]
        self.zones: dict[str, Zone] = {}
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order, self.now_ns = count(), 0
        for name in names:
            self.start(name)

    def start(self, name: str) -> None:
        zone = Zone(name, len(self.zones) * PERIOD_NS // 3, Ownership(name))
        for other in self.zones.values():
            other.ownership.note_alive(name, True)
            zone.ownership.note_alive(other.name, True)
        self.zones[name] = zone
        self._at(self.now_ns + zone.phase_ns + 1, lambda: self._frame_set(zone))

    def kill(self, name: str) -> Zone:
        for other in self.zones.values():
            other.ownership.note_alive(name, False)
        return self.zones.pop(name)

    def run(self, until_ns: int) -> None:
        while self._events and self._events[0][0] <= until_ns:
            self.now_ns, _, happen = heapq.heappop(self._events)
            happen()
        self.now_ns = until_ns

    def owners(self, robot: str) -> set[str]:
        return {zone.name for zone in self.zones.values() if zone.ownership.owns(robot)}

    def _at(self, t_ns: int, happen: Callable[[], None]) -> None:
        heapq.heappush(self._events, (t_ns, next(self._order), happen))

    def _frame_set(self, zone: Zone) -> None:
        if self.zones.get(zone.name) is not zone:
            return
        t_ns, own = self.now_ns, zone.ownership
        tracked = [robot for robot in self.robots if self.sees(zone.name, robot, t_ns)]
        zone.published += [(t_ns, robot) for robot in self.robots if own.publishes(robot, t_ns)]
        zone.n += 1
        is_due = zone.n % EXCHANGE == 0
        better = {r: best for r in self.robots if (best := self.better(zone.name, r, t_ns))} if is_due else {}
        if own.step(t_ns, tracked, set(self.robots) - set(tracked), better) or is_due:
            self._publish(zone, encode(own.report(t_ns, zone.n % (10 * EXCHANGE) == 0)))
        self._at(t_ns + PERIOD_NS, lambda: self._frame_set(zone))

    def _publish(self, zone: Zone, data: bytes) -> None:
        for other in [other for other in self.zones.values() if other is not zone]:
            for delay_ns in self.deliver():
                self._at(
                    self.now_ns + delay_ns,
                    lambda other=other: other.ownership.receive(zone.name, decode(data, ZoneReport)),
                )


class Faults(Hall):
    """Four zones that see robots at random, with messages that are lost, late, repeated and out of order until
    `calm_ns`. The first of the living zones that see a robot sees it best."""

    def __init__(self, rng: np.random.Generator, calm_ns: int) -> None:
        self._rng, self._calm_ns = rng, calm_ns
        self._seen = rng.random((STEPS, 4, 5)) < 0.4
        super().__init__("abcd", self.sees_now, self.best_other, self.delays)

    def sees_now(self, zone: str, robot: str, t_ns: int) -> bool:
        step = min(t_ns // (EXCHANGE * PERIOD_NS), STEPS - 1)
        return bool(self._seen[step, "abcd".index(zone), int(robot[-1])])

    def seeing(self, robot: str) -> list[str]:
        return sorted(name for name in self.zones if self.sees_now(name, robot, self.now_ns))

    def best_other(self, zone: str, robot: str, t_ns: int) -> str | None:
        best = self.seeing(robot)[:1]
        return best[0] if best not in ([], [zone]) else None

    def delays(self) -> list[int]:
        if self.now_ns >= self._calm_ns:
            return [LATENCY_NS]
        return self._rng.integers(0, 30 * PERIOD_NS, self._rng.choice([0, 0, 1, 1, 2])).tolist()

    def start_or_kill(self) -> None:
        name = str(self._rng.choice(list("abcd")))
        if name not in self.zones:
            self.start(name)
        elif len(self.zones) > 2 and self._rng.random() < 0.5:
            self.kill(name)


@pytest.mark.parametrize("seed", range(8))
def test_after_any_faults_every_robot_has_one_owner(seed: int):
    """Zones die and restart, too. Once all messages arrive, the zones that live agree: each robot that one of them sees
    belongs to the best one."""
    calm_ns = STEPS * EXCHANGE * PERIOD_NS
    hall = Faults(np.random.default_rng(seed), calm_ns)
    for t_ns in range(0, calm_ns, 4 * EXCHANGE * PERIOD_NS):
        hall.run(t_ns)
        hall.start_or_kill()
    hall.run(calm_ns + 30 * PERIOD_NS)  # the last late message
    hall.run(hall.now_ns + 30 * EXCHANGE * PERIOD_NS)
    for robot in hall.robots:
        assert len({zone.ownership.claims.get(robot) for zone in hall.zones.values()}) == 1
        assert len(hall.owners(robot)) <= 1
        if seeing := hall.seeing(robot):
            assert hall.owners(robot) == {seeing[0]}


def place(robot: str, t_ns: int) -> tuple[float, bool]:
    """Of a robot that goes back and forth between both ends of a hall, 0 and 1, in its own time; whether it goes up."""
    phase = (t_ns * 1e-9 / (0.9 + 0.3 * int(robot[-1]))) % 2.0
    return min(phase, 2.0 - phase), phase < 1.0


def crossing(zone: str, robot: str, t_ns: int) -> bool:
    """Both see it at the border; zone b has acquired it only some time after it could see it."""
    at, goes_up = place(robot, t_ns)
    return at < 0.95 if zone == "a" else at > (0.6 if goes_up else 0.3)


def nearer(zone: str, robot: str, t_ns: int) -> str | None:
    best = "a" if place(robot, t_ns)[0] < 0.5 else "b"
    return best if best != zone else None


def test_poses_have_no_gap_and_no_double():
    """Of 20 s of crossings between two zones with other times of frame sets. Who publishes a pose sees the robot."""
    hall = Hall("ab", crossing, nearer, lambda: [LATENCY_NS])
    hall.run(24 * 10**9)
    for robot in hall.robots:
        poses = sorted(
            (t_ns, zone.name)
            for zone in hall.zones.values()
            for t_ns, name in zone.published
            if name == robot and t_ns > START_NS
        )
        changes = [(one[0], other[0]) for one, other in pairwise(poses) if one[1] != other[1]]
        assert len(changes) > 5
        assert max(later - t_ns for (t_ns, _), (later, _) in pairwise(poses)) <= 1.25 * PERIOD_NS
        assert all(later - t_ns >= 2 * EXCHANGE * PERIOD_NS for (_, t_ns), (later, _) in pairwise(changes)), (
            "twice"
        )
        assert all(crossing(zone, robot, t_ns) for t_ns, zone in poses)


def test_two_zones_that_find_a_robot_at_once_agree_after_one_message_each():
    first, second = Ownership("a"), Ownership("b")
    for one, name in ((first, "b"), (second, "a")):
        one.note_alive(name, True)
        one.receive(name, ZoneReport(t_ns=0))
        assert one.step(1, ["r"], [], {})
        assert one.owns("r")
        assert not one.publishes("r", 1), "before the others have heard of it"
    first.receive("b", second.report(1, False))
    second.receive("a", first.report(1, False))
    assert not first.owns("r")
    assert second.publishes("r", 2)


def test_a_zone_claims_nothing_before_it_has_heard_the_living_zones():
    """Otherwise a restarted server would publish what another one owns."""
    late = Ownership("b")
    late.note_alive("a", True)
    assert not late.step(1, ["r"], [], {})
    late.receive("a", ZoneReport(t_ns=1, claims={"r": Claim(7, "a", 0)}))
    assert not late.step(2, ["r"], [], {})
    late.note_alive("a", False)
    assert late.claims["r"] == Claim(8, "b", 2), "of the dead zone"
    assert late.publishes("r", 3)


def test_a_robot_that_its_owner_lost_is_searched_by_all():
    zone = Ownership("b")
    zone.note_alive("a", True)
    zone.receive("a", ZoneReport(t_ns=1, claims={"r": Claim(1, "a", 0), "s": Claim(1, "a", 0)}, lost=("s",)))
    assert (zone.searches("r"), zone.searches("s"), zone.searches("new")) == (False, True, True)
    zone.receive("a", ZoneReport(t_ns=0, lost=("r",)))
    assert not zone.searches("r"), "a report that is late"


@pytest.mark.parametrize(
    "wrong",
    [
        {"claims": {"r": Claim(0, "a", 0)}},
        {"claims": {"r": Claim(1 << 62, "a", 0)}},
        {"claims": {"r": Claim(1, "*", 0)}},
        {"lost": ("**",)},
    ],
)
def test_invalid_reports_are_refused(wrong: dict):
    report = {"t_ns": 0, "claims": {"r": Claim(1, "a", 0)}}
    assert decode(encode(ZoneReport(**report)), ZoneReport) == ZoneReport(**report)
    with pytest.raises(MessageError):
        decode(encode(ZoneReport(**report | wrong)), ZoneReport)
