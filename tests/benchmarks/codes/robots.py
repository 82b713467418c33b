# SPDX-License-Identifier: BSD-3-Clause
"""Sixty identical robots that cross, are covered and exchanged: poses of another robot, and those that are missing."""

from collections import Counter
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from camera_node.detection.roundels import Roundels
from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import rotation_from_vector
from fusion.model.robots import Robot
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.named_markers import MIN_VIEWS
from fusion.tracking.tracker import Tracker
from tests.fusion.synthetic import PERIOD_NS, Arena, ring

ROBOTS, CAMERAS = 60, 8
DIAMETER_M = 0.08
UNSEEN, UNREAD = 0.1, 0.2  # shares of the views that are not detected, and of the detections without a name
HIDDEN_S, PERIOD_S = 0.5, 2.0  # how long a robot is covered, and how often
WRONG_M = 0.05  # of a pose of another robot
WITHIN_S = 0.2  # goal of the acquisition after two cameras see a robot


@dataclass(frozen=True)
class Crossing:
    """The places of identical robots on Lissajous figures through the arena.

    Each is covered in a part of each period, together with another one; in the middle of it, the two change places.
    """

    rate: Array
    phase: Array
    begin_s: Array

    @classmethod
    def of(cls, rng: np.random.Generator) -> "Crossing":
        """Random ones; two robots at a time are covered together, and exchanged in every other period."""
        pairs = np.repeat(rng.uniform(0.3, PERIOD_S - HIDDEN_S, ROBOTS // 2), 2)
        return cls(rng.uniform(0.3, 0.7, (ROBOTS, 2)), rng.uniform(0, 2 * np.pi, (ROBOTS, 2)), pairs)

    def is_covered(self, k: int, t: float) -> bool:
        """Whether no camera sees robot k."""
        return 0 <= t % PERIOD_S - self.begin_s[k] < HIDDEN_S

    def place(self, k: int, t: float) -> tuple[Array, Array]:
        """R (3, 3) and p (3,) of robot k, which drives along its figure, or along that of the other one of its pair."""
        ended = (
            int((t - self.begin_s[k] - HIDDEN_S / 2) // PERIOD_S) + 1
        )  # covers that have passed their middle
        k = k ^ 1 if ended % 2 else k
        at = self.rate[k] * t + self.phase[k]
        x, y = 1.3 * np.sin(at)
        heading = np.arctan2(*(self.rate[k] * np.cos(at))[::-1])
        return rotation_from_vector([0.0, 0.0, heading]), np.array([x, y, 0.1 + 0.01 * (k % 10)])


def crossing_robots(seconds: float, seed: int = 1) -> tuple[str, ...]:
    """Track the robots; a row of the table."""
    rng = np.random.default_rng(seed)
    crossing = Crossing.of(rng)
    names = [f"r{k}" for k in range(ROBOTS)]
    robots = {name: Robot(diameter_m=DIAMETER_M, code=k + 1) for k, name in enumerate(names)}
    motions = {name: partial(crossing.place, k) for k, name in enumerate(names)}
    arena = Arena(
        robots,
        motions,
        ring(CAMERAS),
        tuple(rng.uniform(-0.45, 0.45, CAMERAS)),
        sigma_px=0.1,
        hidden=lambda name, _, t: crossing.is_covered(int(name[1:]), t) or rng.uniform() < UNSEEN,
    )
    tracker, synchronizer = Tracker(arena.cameras, robots), FrameSynchronizer(PERIOD_NS)
    for frame in arena.frames(round(seconds * 1e9 / PERIOD_NS)):
        synchronizer.add(replace(frame, detected=_partly_read(frame.roundels, rng)))
    shown = tracked = wrong = late = 0
    since = np.full(ROBOTS, np.inf)
    for frame_set in synchronizer.finish():
        t = arena.seconds(frame_set.t_ns)
        result = tracker.track(frame_set)
        poses = {pose.robot: pose for pose in result.poses if pose.state == "tracked"}
        views = Counter(code for frame in frame_set.frames for code in set(frame.roundels.id.tolist()))
        for k, name in enumerate(names):
            since[k] = min(since[k], t) if views[k + 1] >= MIN_VIEWS else np.inf
            if name in poses:
                off = np.linalg.norm(np.array(poses[name].position) - crossing.place(k, t)[1])
                wrong += bool(off > WRONG_M and not crossing.is_covered(k, t))
            if t - since[k] > WITHIN_S:
                shown, tracked = shown + 1, tracked + (name in poses)
                late += name not in poses
    return str(shown), f"{100 * tracked / shown:.2f}", str(wrong), str(late)


def _partly_read(roundels: Roundels, rng: np.random.Generator) -> Roundels:
    """The roundels, some without a name."""
    unread = rng.uniform(size=len(roundels)) < UNREAD
    unknown = {
        name: np.where(unread, np.nan, getattr(roundels, name))
        for name in ("id_probability", "rotation_rad", "rotation_sigma")
    }
    return replace(roundels, id=np.where(unread, -1, roundels.id).astype(np.int32), **unknown)
