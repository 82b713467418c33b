# SPDX-License-Identifier: BSD-3-Clause
"""What the servers of an arena's zones tell each other: which zone owns which robot, and full states near borders."""

from typing import NamedTuple

import msgspec
import numpy as np

from camera_node.foundation.arrays import Array, Index
from camera_node.foundation.config import is_name
from camera_node.geometry.pose import rotation_from_wxyz, wxyz_from_rotation
from camera_node.protocol.messages import VERSION, MessageError
from fusion.model.states import States
from fusion.protocol.pose_messages import MAX_NUMBER, QUATERNION_SLACK, covariance_bytes

MAX_EPOCH = 1 << 62  # so that its successor is an integer of 64 bits, too


class Claim(NamedTuple):
    """That a zone owns a robot. Of two claims the larger one holds: the higher epoch, then the later name."""

    epoch: int
    zone: str
    since_ns: int  # the zone publishes later poses; those until then are the previous owner's


class ZoneReport(msgspec.Struct, frozen=True, kw_only=True):
    """What one zone knows of the owners of robots.

    Attributes:
        t_ns: increases from one report of a zone to the next.
        claims: the highest claim that the sender knows, by robot; of all robots, or of those that it owned last.
        lost: robots that the sender owns but does not see.
        follows: robots that the sender tracks and another zone owns.
    """

    version: int = VERSION
    t_ns: int
    claims: dict[str, Claim] = {}
    lost: tuple[str, ...] = ()
    follows: tuple[str, ...] = ()

    def check(self) -> None:
        """Raise MessageError unless names and epochs are possible."""
        names = {*self.claims, *self.lost, *self.follows, *(c.zone for c in self.claims.values())}
        if not all(map(is_name, names)):
            raise MessageError("an invalid name of a zone or a robot")
        if not all(0 < claim.epoch < MAX_EPOCH for claim in self.claims.values()):
            raise MessageError("an epoch is out of range")


class ZoneStates(msgspec.Struct, frozen=True, kw_only=True):
    """The states at `t_ns` of robots that one zone owns and a neighbour's cameras may see, so that it tracks them too.

    Columns, one row a robot: `motion` (R, 13) <f8 position, quaternion wxyz, velocity and angular velocity;
    `covariance` (R, 144) <f4; all as in `RobotPose`.
    """

    version: int = VERSION
    t_ns: int
    robots: tuple[str, ...]
    motion: bytes
    covariance: bytes

    @classmethod
    def of(cls, t_ns: int, names: tuple[str, ...], states: States, rows: Index) -> "ZoneStates":
        """The message of the robots in `rows`, of all N names and states."""
        selected = states.select(rows)
        motion = np.column_stack([selected.p, wxyz_from_rotation(selected.R), selected.v, selected.omega])
        return cls(
            t_ns=t_ns,
            robots=tuple(names[k] for k in rows.tolist()),
            motion=motion.astype("<f8").tobytes(),
            covariance=covariance_bytes(selected.P),
        )

    def check(self) -> None:
        """Raise MessageError unless the columns' sizes agree, the numbers are in range and quaternions of length 1."""
        n = len(self.robots)
        if (len(self.motion), len(self.covariance)) != (104 * n, 576 * n):
            raise MessageError(f"the columns have other sizes than those of {n} robots")
        motion, covariance = self._motions(), np.frombuffer(self.covariance, "<f4")
        if not ((np.abs(motion) <= MAX_NUMBER).all() and np.isfinite(covariance).all()):
            raise MessageError("the states are out of range")
        if not (np.abs(np.linalg.norm(motion[:, 3:7], axis=1) - 1.0) < QUATERNION_SLACK).all():
            raise MessageError("a quaternion is not of length 1")

    def states(self) -> States:
        """Of all R robots."""
        p, wxyz, v, omega = np.split(self._motions(), [3, 7, 10], axis=1)
        P = np.frombuffer(self.covariance, "<f4").reshape(-1, 12, 12).astype(float)
        return States(rotation_from_wxyz(wxyz), p, omega, v, P)

    def _motions(self) -> Array:
        """(R, 13) positions, quaternions, velocities and angular velocities."""
        return np.frombuffer(self.motion, "<f8").reshape(-1, 13)


def zone_key(arena: str, content: str, zone: str = "*") -> str:
    """The key of what a zone's server publishes.

    Args:
        arena: the arena's name.
        content: `alive` (a liveliness token), `report` (`ZoneReport`), `states/NAME` (`ZoneStates` for the zone NAME),
            and for the first zone, which joins them, `markers` (`Markers`) and `status` (`FusionStatus`).
        zone: the sender.
    """
    return f"{arena}/fusion/zone/{zone}/{content}"


def zone_of(key: str) -> str:
    """The sender of a key that `zone_key` made."""
    return key.split("/")[3]
