# SPDX-License-Identifier: BSD-3-Clause
"""Which zone owns which robot: at most one publishes its poses. Reads no clock and no network.

A claim is a robot's epoch and its owner. Every zone has the largest claim that it has heard of each robot, so all zones
that hear the same claims agree, whatever their order and repetitions (a last-writer-wins register: Shapiro et al.
2011). Only the owner hands a robot over, so no two zones own it while messages flow. A robot without an owner, or whose
owner is dead or has lost it, belongs to whoever finds it. docs/design/zones.md describes the protocol.
"""

from collections.abc import Iterable, Mapping

from fusion.protocol.zone_messages import Claim, ZoneReport

UNCLAIMED = Claim(0, "", 0)
HANDOVER_NS = 50_000_000  # from a handover's message to the new owner's first pose, on a busy machine


class Ownership:
    """The claims on all robots, as one zone knows them.

    Args:
        zone: this zone.

    Attributes:
        claims: the largest claim on each robot.
    """

    def __init__(self, zone: str) -> None:
        self._zone = zone
        self.claims: dict[str, Claim] = {}
        self._alive: set[str] = set()  # other zones
        self._reports: dict[str, ZoneReport] = {}  # the last one of each living zone
        self._mine: set[str] = set()  # robots that this zone owned at the last report or owns
        self._lost: frozenset[str] = frozenset()
        self._follows: frozenset[str] = frozenset()
        self._handed_over: dict[str, Claim] = {}  # the last handover of each robot by this zone
        self._t_ns = self._interval_ns = 0  # of the last frame set, and since the one before

    @property
    def others(self) -> frozenset[str]:
        """The other zones that are alive."""
        return frozenset(self._alive)

    def note_alive(self, zone: str, is_alive: bool) -> None:
        """Take note that another zone's server is there, or is not any more: its robots that this zone tracks are taken
        at once, from the next frame set."""
        if is_alive:
            self._alive.add(zone)
        else:
            self._alive.discard(zone)
            self._reports.pop(zone, None)
            self._claim_free(self._follows)

    def receive(self, zone: str, report: ZoneReport) -> None:
        """Take the claims of another zone's report; a late one can't take any back."""
        for robot, claim in report.claims.items():
            self.claims[robot] = max(claim, self._claim(robot))
        last = self._reports.get(zone)
        if zone in self._alive and (last is None or report.t_ns > last.t_ns):
            self._reports[zone] = report

    def owns(self, robot: str) -> bool:
        """Whether this zone owns a robot."""
        return self._claim(robot).zone == self._zone

    def publishes(self, robot: str, t_ns: int) -> bool:
        """Whether this zone publishes the robot's pose at `t_ns`: it owns it by then, or hands it over later."""
        claim = self._claim(robot)
        if claim.zone == self._zone:
            return t_ns > claim.since_ns
        return t_ns <= claim.since_ns and claim == self._handed_over.get(robot)

    def searches(self, robot: str) -> bool:
        """Whether this zone searches for a robot that it does not see: no other zone owns it and sees it."""
        return self.owns(robot) or self._is_free(robot)

    def followers(self, robot: str) -> list[str]:
        """The other zones that track a robot without owning it."""
        return [zone for zone, report in self._reports.items() if robot in report.follows]

    def step(self, t_ns: int, tracked: Iterable[str], lost: Iterable[str], better: Mapping[str, str]) -> bool:
        """Claim robots that no zone owns, and hand over own ones, after a frame set.

        Args:
            t_ns: time of the frame set.
            tracked: robots that this zone sees.
            lost: robots that it does not see any more, or never saw.
            better: the zone that sees an own robot better, by robot; it must be one of its followers.

        Returns:
            whether claims changed.
        """
        tracked, before = set(tracked), dict(self.claims)
        interval_ns, self._t_ns = t_ns - self._t_ns, t_ns
        period_ns, self._interval_ns = min(interval_ns, self._interval_ns), interval_ns  # also after a pause
        self._claim_free(tracked)
        for robot, zone in better.items():
            claim = self._claim(robot)
            if claim.zone == self._zone and t_ns > claim.since_ns and zone in self.followers(robot):
                since_ns = t_ns + _whole_periods(HANDOVER_NS, period_ns)
                self.claims[robot] = self._handed_over[robot] = Claim(claim.epoch + 1, zone, since_ns)
        self._lost = frozenset(robot for robot in lost if self.owns(robot))
        self._follows = frozenset(robot for robot in tracked if not self.owns(robot))
        return self.claims != before

    def report(self, t_ns: int, of_all: bool) -> ZoneReport:
        """What this zone knows: of all robots, or of those that it owns, or owned at the last report of all."""
        self._mine |= {robot for robot in self.claims if self.owns(robot)}
        claims = {k: v for k, v in self.claims.items() if of_all or k in self._mine}
        if of_all:
            self._mine = {robot for robot in claims if self.owns(robot)}
        return ZoneReport(
            t_ns=t_ns,
            claims=claims,
            lost=tuple(sorted(self._lost)),
            follows=tuple(sorted(self._follows)),
        )

    def rename(self, renamed: Mapping[str, str]) -> None:
        """Continue with robots that have other names; `renamed` maps old names to new ones."""
        for before in renamed.keys() & self.claims.keys():
            claim, after = self.claims[before], renamed[before]
            self.claims[after] = max(claim, self._claim(after))

    def _claim_free(self, robots: Iterable[str]) -> None:
        """Claim those of some robots that no zone owns, if every living zone has said what it owns."""
        for robot in robots if self._alive <= self._reports.keys() else ():
            if self._is_free(robot):
                self.claims[robot] = Claim(self._claim(robot).epoch + 1, self._zone, self._t_ns)

    def _claim(self, robot: str) -> Claim:
        return self.claims.get(robot, UNCLAIMED)

    def _is_free(self, robot: str) -> bool:
        """Whether no other living zone owns a robot and sees it."""
        owner = self._claim(robot).zone
        if owner == self._zone:
            return False
        report = self._reports.get(owner)
        return owner not in self._alive or (report is not None and robot in report.lost)


def _whole_periods(least_ns: int, period_ns: int) -> int:
    """Periods and a quarter, `least_ns` or longer: after a frame set and before the next one, also if that is late."""
    return -(-least_ns // max(period_ns, 1)) * period_ns + period_ns // 4
