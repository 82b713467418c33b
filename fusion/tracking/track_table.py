# SPDX-License-Identifier: BSD-3-Clause
"""The table of all robots: markers, states, and which robots are tracked, coasting or lost."""

from dataclasses import replace

import numpy as np

from camera_node.foundation.arrays import Array, Index, Mask
from fusion import _core
from fusion.model.limits import Limits
from fusion.model.observations import Assignments, MarkerTable
from fusion.model.robots import Robot
from fusion.model.states import MAX_COAST_S, POSITION, THETA, VELOCITY, States, predict
from fusion.protocol.pose_messages import TrackingState
from fusion.protocol.zone_messages import ZoneStates
from fusion.tracking.gating import POSITION_GATE, START_S, START_SIGMAS

ASSOCIATED_M = 0.1  # position sigma above which a robot is acquired again instead of associated
ASSOCIATED_RAD = 0.15  # rotation sigma above which a constellation is: its markers may be exchanged
# The same above which one camera alone does not locate it: its equations are not linear that far. At 0.84 rad, two
# detections displaced a robot by 0.56 m, with a claim of 17 mm.
UNKNOWN_RAD = 0.5
SIMULTANEOUS_M = 0.005  # motion between frames, one sigma, that a residual shows: 1 px at 4 m
START_M = 0.1  # standard deviation of `start_m`
LOCAL_M = 0.3  # position sigma above which a history does not say where a robot is


class TrackTable:
    """States and status of N robots.

    Attributes:
        names, robots, markers: the robots and their marker table.
        single: (N,) robots with a single marker, which has no code: their heading is unknown.
        coded: (N,) robots with a code.
        densities: of their accelerations; see `MotionModel.densities`.
        owned: (N,) robots whose poses this server publishes; all of them in an arena without zones.
        searched: (N,) robots that it acquires while they are missing; the others belong to other zones.
        states: at `t_ns`; a new object after each change.
        status: None for a robot that was never acquired.
        claimed: (N, 12, 12) covariances of the states with the errors of the cameras and of the places of markers,
            which the states' own lack.
        t_ns: time of the last frame set, or None before the first.
    """

    def __init__(self, robots: dict[str, Robot], limits: Limits) -> None:
        n = len(robots)
        self.names, self.robots = tuple(robots), list(robots.values())
        self.markers = MarkerTable.of(self.robots)
        self.coded = np.array([robot.is_coded for robot in self.robots], bool)
        self.single = np.array([robot.is_single for robot in self.robots], bool) & ~self.coded
        self.densities = [robot.densities for robot in self.robots]
        self.owned, self.searched = np.ones((2, n), bool)
        self.states = States.at_rest(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), START_SIGMAS)
        self.claimed = self.states.P
        self.status: list[TrackingState | None] = [None] * n
        self.t_ns: int | None = None
        self._limits = limits
        self._row = {name: k for k, name in enumerate(robots)}
        self._seen, self._seen_ns = np.zeros(n, bool), np.zeros(n, np.int64)
        self._received: dict[str, ZoneStates] = {}  # the last one of each zone since it was applied

    @property
    def alive(self) -> Mask:
        """(N,) robots that are tracked or coasting."""
        return np.array([status in ("tracked", "coasting") for status in self.status], bool)

    @property
    def tracked(self) -> Mask:
        """(N,) robots whose status is `tracked`."""
        return np.array([status == "tracked" for status in self.status], bool)

    @property
    def located(self) -> Mask:
        """(N,) robots that the last frame set shows and determines, if the rig is right: claims may be wider."""
        return self._seen & self.alive & ~self._is_uncertain(self.states.P)

    @property
    def speed_m_s(self) -> float:
        """The speed of the fastest of the robots that the last frame set located."""
        return float(np.linalg.norm(self.states.v[self.located], axis=1).max(initial=0.0))

    def unseen_s(self, t_ns: int) -> Array:
        """(N,) seconds until `t_ns` since the last frame set that observed each robot; 0 for those in acquisition."""
        return np.where(self._seen_ns > 0, np.maximum(t_ns - self._seen_ns, 0) * 1e-9, 0.0)

    def inherit(self, old: "TrackTable", renamed: dict[str, str]) -> dict[int, int]:
        """Copy states and status of the robots that `old` has with the same markers; `renamed` maps old names.

        Returns:
            their old rows by new row.
        """
        same: dict[int, int] = {}
        self.t_ns = old.t_ns
        old_rows = {renamed.get(name, name): k for k, name in enumerate(old.names)}
        for row, (name, robot) in enumerate(zip(self.names, self.robots, strict=True)):
            k = old_rows.get(name)
            if k is None or not robot.has_markers_of(old.robots[k]):
                continue
            self.states = self.states.with_rows(np.array([row]), old.states.select(np.array([k])))
            self.status[row], self._seen_ns[row] = old.status[k], old._seen_ns[k]
            self._seen[row], same[row] = old._seen[k], k
            used = old.markers.position[:, old.markers.robot == k]
            self.markers.place(row, used.T, old.markers.frame[k])
        return same

    def interval_s(self, t_ns: int) -> float:
        """The prediction interval from the last frame set to `t_ns`."""
        dt = START_S if self.t_ns is None else max((t_ns - self.t_ns) * 1e-9, START_S)
        return min(dt, MAX_COAST_S)

    def associable(self, predicted: States) -> Mask:
        """(N,) robots whose prediction is good enough to associate their detections with it.

        These include robots with a detection in the last frame set, even if their range is not well known.
        """
        position2, rotation2 = (
            np.einsum("nii->n", predicted.P[:, part, part]) / 3 for part in (POSITION, THETA)
        )
        rotated = (rotation2 > ASSOCIATED_RAD**2) & ~self.single
        return self.alive & ((position2 < ASSOCIATED_M**2) & ~rotated | self._seen)

    def needed_detections(self, predicted: States, spread_s: float) -> Index:
        """(N,) how many detections, by two cameras, each robot needs because its prediction does not check them. 0
        where the prediction does, or a code.

        It does not where the rotation does not tell markers apart, or the robot may have moved so far since the last
        frame set that the detections near it are those of others. Fewer equations than determine a pose, and in frames
        that are `spread_s` apart also an unknown velocity, fit any roundels.
        """
        rotation2, velocity2, moved2 = (
            np.einsum("nii->n", P[:, part, part]) / 3
            for P, part in (
                (predicted.P, THETA),
                (predicted.P, VELOCITY),
                (predicted.P - self.states.P, POSITION),
            )
        )
        vague = (rotation2 > UNKNOWN_RAD**2) & ~self.single | (moved2 > ASSOCIATED_M**2)
        # Of two equations each; the velocity has a prior, so that as many as unknowns suffice with it.
        of_body = np.where(velocity2 * spread_s**2 > SIMULTANEOUS_M**2, 6, 4)
        return np.where(vague & ~self.coded, np.where(self.single, 2, of_body), 0)

    def history_chi2(self, k: int, p: Array, covariance: Array) -> float:
        """Squared Mahalanobis distance of p from robot k's last position, or from its start if never acquired."""
        position, own = self.states.p[k], self.states.P[k, POSITION, POSITION]
        if self.status[k] is None:
            start = self.robots[k].start_m
            if start is None:
                return 0.0
            position, own = np.array(start), START_M**2 * np.eye(3)
        error = p - position
        return float(error @ np.linalg.solve(own + covariance, error))

    def are_elsewhere(self, rows: Index, states: States) -> Mask:
        """(K,) robots (rows) that were acquired before, and are not at these states now."""
        elsewhere = [
            self.status[k] is not None and self._differs(k, p, P)
            for k, p, P in zip(rows.tolist(), states.p, states.P, strict=True)
        ]
        return np.array(elsewhere, bool)

    def is_local(self, k: int) -> bool:
        """Whether its start or its history says where robot k is."""
        if self.status[k] is None:
            return self.robots[k].start_m is not None
        return bool(np.trace(self.states.P[k, POSITION, POSITION]) < 3 * LOCAL_M**2)

    def observe(self, t_ns: int, assignments: Assignments) -> None:
        """Update the status: tracked while detected, coasting for a while without detections, then lost."""
        self.t_ns = t_ns
        seen = np.zeros(len(self.robots), bool)
        seen[self.markers.robot[assignments.marker]] = True
        self._seen, self._seen_ns[seen] = seen, t_ns
        silent = (t_ns - self._seen_ns) * 1e-9 > self._limits.lost_after_s
        uncertain = self._is_uncertain(self.claimed)
        newly_lost = []
        for k, status in enumerate(self.status):
            if seen[k]:
                self.status[k] = "coasting" if uncertain[k] else "tracked"
            elif status in ("tracked", "coasting"):
                self.status[k] = "lost" if silent[k] else "coasting"
                newly_lost += [k] if silent[k] else []
        if newly_lost:
            self._stop(newly_lost)

    def adopt(self, rows: Index, states: States) -> None:
        """Take the states of robots that were acquired."""
        self.states = self.states.with_rows(rows, states)
        for k in rows.tolist():
            self.status[k] = "tracked"

    def lose(self, rows: Index) -> None:
        """Mark robots as lost."""
        for k in rows.tolist():
            self.status[k] = "lost"

    def marker_states(self, rows: Index) -> tuple[Array, Array]:
        """Of markers `rows`, world frame: positions, velocities and normals (3, K, 3), and position covariances (K, 3,
        3)."""
        markers = self.markers
        shapes = markers.position.take(rows, 1), markers.normal.take(rows, 1)
        return _core.marker_states(self.states.bodies, self.claimed, markers.robot[rows], *shapes)

    def alive_markers(self) -> tuple[Array, Array]:
        """Positions (K, 3) and covariances (K, 3, 3) of all markers of tracked and coasting robots."""
        vectors, covariances = self.marker_states(np.flatnonzero(self.alive[self.markers.robot]))
        return vectors[0], covariances

    def receive(self, zone: str, states: ZoneStates) -> None:
        """Take the states of another zone's robots with the next prediction after their time."""
        self._received[zone] = states

    def apply_received(self) -> Index:
        """Track robots of other zones from the states that their owners sent, predicted to the last frame set.

        A robot that is tracked already stays as it is, unless it is somewhere else: its owner is right.

        Returns:
            rows of the robots with other states.
        """
        t_ns, started = self.t_ns or 0, [np.empty(0, np.intp)]
        for zone in [zone for zone, message in self._received.items() if message.t_ns <= t_ns]:
            message = self._received.pop(zone)
            at = np.array([self._row.get(name, -1) for name in message.robots], np.intp)
            known = np.flatnonzero((at >= 0) & ~self.owned[at])
            rows, dt = at[known], np.full(len(known), (t_ns - message.t_ns) * 1e-9)
            densities = np.array([self.densities[k] for k in rows.tolist()]).reshape(-1, 2)
            states, _ = predict(message.states().select(known), dt, densities, self.single[rows])
            differ = [self._differs(k, states.p[i], states.P[i]) for i, k in enumerate(rows.tolist())]
            new = np.flatnonzero(~self.alive[rows] | np.array(differ, bool))
            self.adopt(rows[new], states.select(new))
            self._seen[rows[new]], self._seen_ns[rows[new]] = True, message.t_ns
            started.append(rows[new])
        return np.concatenate(started)

    def _differs(self, k: int, p: Array, P: Array) -> bool:
        """Whether a robot is not at p."""
        return self.history_chi2(k, p, P[POSITION, POSITION]) > POSITION_GATE

    def _stop(self, rows: list[int]) -> None:
        """Set the velocities of robots to zero."""
        omega, v = self.states.omega.copy(), self.states.v.copy()
        omega[rows] = v[rows] = 0
        self.states = replace(self.states, omega=omega, v=v)

    def _is_uncertain(self, covariance: Array) -> Mask:
        """(N,) robots with a position sigma above `tracked_sigma_m` in some direction, by covariances (N, 12, 12)."""
        position, limit = covariance[:, POSITION, POSITION], self._limits.tracked_sigma_m**2
        uncertain = np.einsum("nii->n", position) > limit  # the trace bounds every eigenvalue
        if uncertain.any():
            uncertain[uncertain] = np.linalg.eigvalsh(position[uncertain])[:, -1] > limit
        return uncertain
