# SPDX-License-Identifier: BSD-3-Clause
"""The table of all robots: markers, states, and which robots are tracked, coasting or lost."""

from dataclasses import replace

import numpy as np

from camera_node.foundation.arrays import Array, Index, Mask
from fusion.model.limits import Limits
from fusion.model.observations import Assignments, MarkerTable
from fusion.model.robots import Robot
from fusion.model.states import MAX_COAST_S, POSITION, THETA, States
from fusion.protocol.pose_messages import ShardPoses, TrackingState
from fusion.protocol.shards import Shard, shard_poses_of, states_of
from fusion.tracking.gating import START_S, START_SIGMAS

ASSOCIATED_M = 0.1  # position sigma above which a robot is acquired again instead of associated
ASSOCIATED_RAD = 0.15  # rotation sigma above which a constellation is: its markers may be exchanged
START_M = 0.1  # standard deviation of `start_m`
LOCAL_M = 0.3  # position sigma above which a history does not say where a robot is
MAX_SHARD_MESSAGES = 1000  # of other shards, between two frame sets


class TrackTable:
    """States and status of N robots.

    Attributes:
        names, robots, markers: the robots and their marker table.
        single: (N,) robots with a single marker.
        densities: of their accelerations; see `MotionModel.densities`.
        owned: (N,) robots that this shard estimates.
        states: at `t_ns`; a new object after each change.
        status: None for a robot that was never acquired.
        claimed: (N, 12, 12) covariances of the states with the errors of the cameras, which the states' own lack.
        t_ns: time of the last frame set, or None before the first.
    """

    def __init__(self, robots: dict[str, Robot], limits: Limits, shard: Shard) -> None:
        n = len(robots)
        self.names, self.robots = tuple(robots), list(robots.values())
        self.markers = MarkerTable.of(self.robots)
        self.single = np.array([robot.is_single for robot in self.robots], bool)
        self.densities = [robot.densities for robot in self.robots]
        self.owned = np.array([shard.owns(name) for name in self.names], bool)
        self.states = States.at_rest(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), START_SIGMAS)
        self.claimed = self.states.P
        self.status: list[TrackingState | None] = [None] * n
        self.t_ns: int | None = None
        self._limits = limits
        self._row = {name: k for k, name in enumerate(robots)}
        self._seen, self._seen_ns = np.zeros(n, bool), np.zeros(n, np.int64)
        self._messages: list[ShardPoses] = []  # of other shards since the last prediction

    @property
    def alive(self) -> Mask:
        """(N,) robots that are tracked or coasting."""
        return np.array([status in ("tracked", "coasting") for status in self.status], bool)

    @property
    def tracked(self) -> Mask:
        """(N,) robots whose status is `tracked`."""
        return np.array([status == "tracked" for status in self.status], bool)

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
        self._seen, self._seen_ns[seen & self.owned] = seen, t_ns
        silent = (t_ns - self._seen_ns) * 1e-9 > self._limits.lost_after_s
        uncertain = self._is_uncertain()
        newly_lost = []
        for k, status in enumerate(self.status):
            if not self.owned[k]:
                self.status[k] = "lost" if status is not None and silent[k] else status
            elif seen[k]:
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

    def marker_positions(self, rows: Index) -> tuple[Array, Array]:
        """Of markers `rows`: arms (K, 3) from the robot's origin and position covariances (K, 3, 3), world frame."""
        owner, positions = self.markers.robot[rows], self.markers.position.take(rows, 1)
        claimed = replace(self.states, P=self.claimed)
        covariances = self.markers.expected(rows, claimed).covariances(0.0)
        return np.einsum("nij,jn->ni", self.states.R[owner], positions), covariances

    def marker_normals(self, rows: Index) -> Array:
        """(K, 3) unit normals of markers `rows`, world frame."""
        return np.einsum("nij,jn->ni", self.states.R[self.markers.robot[rows]], self.markers.normal[:, rows])

    def alive_markers(self) -> tuple[Array, Array]:
        """Positions (K, 3) and covariances (K, 3, 3) of all markers of tracked and coasting robots."""
        rows = np.flatnonzero(self.alive[self.markers.robot])
        arms, covariances = self.marker_positions(rows)
        return self.states.p[self.markers.robot[rows]] + arms, covariances

    def shard_poses(self) -> ShardPoses:
        """The poses of this shard's robots for the other shards; valid after the first frame set."""
        assert self.t_ns is not None
        known = np.array([status is not None for status in self.status], bool)
        return shard_poses_of(
            self.names, self.t_ns, self.states, self.status, np.flatnonzero(known & self.owned)
        )

    def receive(self, poses: ShardPoses) -> None:
        """Queue another shard's poses; `apply_received` takes them."""
        if len(self._messages) < MAX_SHARD_MESSAGES:
            self._messages.append(poses)

    def apply_received(self) -> None:
        """Take the received states of other shards' robots, predicted to the last frame set."""
        messages, self._messages = self._messages, []
        if self.t_ns is None:
            return
        for message in messages:
            at = np.array([self._row.get(name, -1) for name in message.robots], np.intp)
            new = np.flatnonzero((at >= 0) & ~self.owned[at] & (message.t_ns > self._seen_ns[at]))
            self.states = self.states.with_rows(at[new], states_of(message, self.t_ns).select(new))
            self._seen_ns[at[new]] = message.t_ns
            for k in new.tolist():
                self.status[at[k]] = message.states[k]
                self._seen[at[k]] = message.states[k] == "tracked"

    def _stop(self, rows: list[int]) -> None:
        """Set the velocities of robots to zero."""
        omega, v = self.states.omega.copy(), self.states.v.copy()
        omega[rows] = v[rows] = 0
        self.states = replace(self.states, omega=omega, v=v)

    def _is_uncertain(self) -> Mask:
        """(N,) robots with a position sigma above `tracked_sigma_m` along some direction."""
        position, limit = self.claimed[:, POSITION, POSITION], self._limits.tracked_sigma_m**2
        uncertain = np.einsum("nii->n", position) > limit  # the trace bounds every eigenvalue
        uncertain[uncertain] = np.linalg.eigvalsh(position[uncertain])[:, -1] > limit
        return uncertain
