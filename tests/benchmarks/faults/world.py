# SPDX-License-Identifier: BSD-3-Clause
"""The true state of a simulated arena at any time, and the faults that its cameras and robots are given."""

import time
from dataclasses import replace

import msgspec
import numpy as np

from camera_node.foundation.arrays import Array
from fusion.model.states import States
from tests.benchmarks.fusion_load import Load

Vector = tuple[float, float, float]


class Clock:
    """The time of an arena that runs in real time."""

    def now_s(self) -> float:
        """Of the monotonic clock."""
        return time.monotonic()

    def now_ns(self) -> int:
        """Unix time."""
        return time.time_ns()


class RobotEvent(msgspec.Struct, frozen=True, kw_only=True):
    """A robot is covered for a while and may be carried then: `before` and `after` are offsets of its path, m.

    It is carried in the middle half of that time, without a jump of its velocity.
    """

    robot: str
    hidden_from_ns: int
    hidden_until_ns: int
    before: Vector = (0.0, 0.0, 0.0)
    after: Vector = (0.0, 0.0, 0.0)

    def offset(self, t_ns: int) -> Array:
        """(3,) of the robot's path at a Unix time."""
        elapsed = (t_ns - self.hidden_from_ns) / (self.hidden_until_ns - self.hidden_from_ns)
        share = min(1.0, max(0.0, 2 * elapsed - 0.5))
        smooth = share**2 * (3 - 2 * share)
        return (1 - smooth) * np.array(self.before) + smooth * np.array(self.after)


class CameraFault(msgspec.Struct, frozen=True, kw_only=True):
    """The faults of a camera; by default it has none.

    Attributes:
        since_ns: when they began.
        silent: it delivers no frames, as if its driver hung.
        picture: what its images show.
        false: roundels that are not there, in each frame.
        loss: share of frames that are lost.
        bursts_s: mean times during which its frames arrive, and during which they are lost, as from a machine that has
            too much to do; both are distributed exponentially.
        delay_ms: of every frame.
        swapped: each two frames arrive in the wrong order.
        doubled: every frame arrives twice.
        step_ms, drift_ppm: errors of its clock.
        turn_rad, shift_m: its true pose differs from its calibrated pose by a motion in its own frame.
        focal_scale: its true focal length over its calibrated one.
    """

    since_ns: int = 0
    silent: bool = False
    picture: str = "live"  # or frozen, black, bright
    false: int = 0
    loss: float = 0.0
    bursts_s: tuple[float, float] | None = None
    delay_ms: float = 0.0
    swapped: bool = False
    doubled: bool = False
    step_ms: float = 0.0
    drift_ppm: float = 0.0
    turn_rad: Vector = (0.0, 0.0, 0.0)
    shift_m: Vector = (0.0, 0.0, 0.0)
    focal_scale: float = 1.0

    def stamp_ns(self, t_ns: int) -> int:
        """What the camera's clock shows at a time."""
        return t_ns + round(self.step_ms * 1e6 + self.drift_ppm * 1e-6 * (t_ns - self.since_ns))


class CameraCommand(msgspec.Struct, frozen=True, kw_only=True):
    """One line of JSON on the standard input of a simulated camera."""

    fault: CameraFault | None = None
    event: RobotEvent | None = None


class World:
    """The robots of a load in real time; thread-safe, since each entry of `events` is replaced as a whole.

    Args:
        load: the robots and cameras.
        epoch_ns: the Unix time of the load's time 0.
    """

    def __init__(self, load: Load, epoch_ns: int) -> None:
        self.load, self.epoch_ns = load, epoch_ns
        self.names = tuple(load.bodies)
        self.events: dict[str, RobotEvent] = {}

    def states(self, t_ns: int) -> States:
        """The true states at a Unix time."""
        states = self.load.paths.at((t_ns - self.epoch_ns) * 1e-9)
        p = states.p.copy()
        for name, event in tuple(self.events.items()):
            p[self.names.index(name)] += event.offset(t_ns)
        return replace(states, p=p)

    def hidden(self, t_ns: int) -> list[int]:
        """Rows of the robots that are covered at a Unix time."""
        events = tuple(self.events.items())
        return [self.names.index(n) for n, e in events if e.hidden_from_ns <= t_ns < e.hidden_until_ns]

    def position(self, robot: str, t_ns: int) -> np.ndarray:
        """(3,) true position of a robot's origin, metres."""
        return self.states(t_ns).p[self.names.index(robot)]
