# SPDX-License-Identifier: BSD-3-Clause
"""Recordings of cameras whose clocks jump or drift, and what the tracker makes of them."""

import functools
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice

import msgspec
import numpy as np

from calib.rig.camera import Camera
from camera_node.geometry.pose import Pose, rotation_from_vector
from camera_node.protocol.messages import Detections
from fusion.protocol.pose_messages import RobotPose
from fusion.recordings.offline_fusion import OfflineArena, Summary, fuse_recording
from tests.benchmarks.fusion_load import START_NS, Load

StampError = Callable[[float], float]  # of a camera's stamps, s, at the true time in s
GRACE_S = 0.1  # after a step, in which poses may be wrong
LAG_S, JITTER_S = 0.012, 0.003  # from exposure to arrival: constant, and mean of an exponential distribution
LONGEST_S = 3600.0
SIGMAS, ERROR_M = 5.0, 0.01  # a pose in state "tracked" is wrong beyond both


def step(at_s: float, size_s: float) -> StampError:
    """Stamps that jump by `size_s` at `at_s`."""
    return lambda t_s: size_s if t_s >= at_s else 0.0


def drift(at_s: float, ppm: float) -> StampError:
    """Stamps that drift from `at_s` on."""
    return lambda t_s: max(t_s - at_s, 0.0) * ppm * 1e-6


@functools.lru_cache(maxsize=4)
def _begun(load: Load) -> tuple[list[Detections], Iterator[Detections]]:
    return [], load.messages(LONGEST_S)


def detections(load: Load, seconds: float) -> list[Detections]:
    """The messages of a load, which are the same whatever the clocks stamp, and of which a shorter time has the first
    ones."""
    known, later = _begun(load)
    n = round(seconds * load.hz) * load.cameras
    known.extend(islice(later, max(0, n - len(known))))
    return known[:n]


def arrivals(
    load: Load, seconds: float, faults: Mapping[str, StampError], jitter_s: float | None = JITTER_S
) -> list[tuple[int, Detections]]:
    """The messages of a load in order of arrival, with the stamps of faulty cameras.

    Without `jitter_s` each frame arrives at its stamp: a recording that has no arrival times.
    """
    rng, messages = np.random.default_rng(load.seed + 9), []
    for message in detections(load, seconds):
        fault = faults.get(message.camera)
        error_ns = round(fault((message.t_ns - START_NS) * 1e-9) * 1e9) if fault else 0
        lag_ns = error_ns if jitter_s is None else round((LAG_S + rng.exponential(jitter_s)) * 1e9)
        stamped = msgspec.structs.replace(
            message, t_ns=message.t_ns + error_ns, sent_ns=message.sent_ns + error_ns
        )
        messages.append((message.t_ns + lag_ns, stamped))
    return sorted(messages, key=lambda arrival: arrival[0])


@dataclass
class Outcome:
    """What a run of the tracker gave.

    Attributes:
        poses: all, of all frame sets.
        errors_m, sigmas: by pose, distance to the truth and Mahalanobis distance of the position.
        used: by camera, the times (s) of the frame sets in which its detections were used.
        log: (s, line) of the tracker.
        moves: cameras that were reported as moved or were recalibrated.
    """

    poses: list[RobotPose] = field(default_factory=list)
    errors_m: list[float] = field(default_factory=list)
    sigmas: list[float] = field(default_factory=list)
    used: dict[str, list[float]] = field(default_factory=dict)
    log: list[tuple[float, str]] = field(default_factory=list)
    moves: list[str] = field(default_factory=list)

    def wrong(self, since_s: float, until_s: float = np.inf) -> list[tuple[float, float, float]]:
        """(time, error in m, sigmas) of tracked poses that are off by more than 5 sigma and 10 mm."""
        return [
            (at_s, error, sigma)
            for pose, error, sigma in zip(self.poses, self.errors_m, self.sigmas, strict=True)
            if since_s < (at_s := seconds(pose.t_ns)) < until_s
            and pose.state == "tracked"
            and error > ERROR_M
            and sigma > SIGMAS
        ]

    def worst_m(self, since_s: float) -> float:
        """The largest error of a tracked pose."""
        rows = zip(self.poses, self.errors_m, strict=True)
        return max((e for p, e in rows if seconds(p.t_ns) > since_s and p.state == "tracked"), default=np.nan)

    def tracked(self, since_s: float) -> float:
        """The share of poses in state "tracked"."""
        return float(np.mean([p.state == "tracked" for p in self.poses if seconds(p.t_ns) > since_s]))

    def reported_s(self, camera: str) -> float:
        """When the camera was first named in a line of the log; infinite if never."""
        return min((at for at, line in self.log if f"camera {camera}" in line), default=np.inf)

    def in_use_since_s(self, camera: str) -> float:
        """The end of the last gap of more than 0.3 s in the use of a camera, or its first use; infinite if unused."""
        times = np.array(self.used.get(camera, [np.inf]))
        gaps = np.flatnonzero(np.diff(times) > 0.3)
        return float(times[gaps[-1] + 1]) if len(gaps) else float(times[0])


def seconds(t_ns: int) -> float:
    """Since the start of a load."""
    return (t_ns - START_NS) * 1e-9


def inaccurate(rig: Mapping[str, Camera], error_px: float) -> dict[str, Camera]:
    """A rig whose rotations and focal lengths displace roundels at the edge of the image by about `error_px`."""
    rng, wrong = np.random.default_rng(5), {}
    for name, camera in rig.items():
        T, sigma = camera.matrix().copy(), error_px / camera.fx
        T[:3, :3] @= rotation_from_vector(rng.normal(size=(1, 3)) * sigma * [1.0, 1.0, 2.0])[0]
        fx, fy = np.array([camera.fx, camera.fy]) * (1 + 2 * sigma * rng.normal(size=2))
        pose = Pose.from_matrix(T)
        wrong[name] = msgspec.structs.replace(camera, T_world_cam=pose, fx=float(fx), fy=float(fy))
    return wrong


def fuse(
    load: Load,
    duration_s: float,
    faults: Mapping[str, StampError],
    jitter_s: float | None = JITTER_S,
    rig: dict[str, Camera] | None = None,
) -> Outcome:
    """Track a recording of faulty cameras, in order of arrival, by the code of `fusion run` and the server.

    Args:
        load, duration_s, faults, jitter_s: see `arrivals`.
        rig: the calibration, if it is not the true one.
    """
    outcome, summary, log = Outcome(), Summary(), _Log()
    logger = logging.getLogger("fusion")
    logger.addHandler(log)
    try:
        arena = OfflineArena(rig or load.rig, load.bodies)
        for result in fuse_recording(arrivals(load, duration_s, faults, jitter_s), arena, summary):
            _add(outcome, load, result.poses)
            for name, use in result.cameras.items():
                if use.used:
                    outcome.used.setdefault(name, []).append(seconds(result.t_ns))
            log.now_s = seconds(result.t_ns)
    finally:
        logger.removeHandler(log)
    return replace(outcome, log=log.lines, moves=summary.moves)


def _add(outcome: Outcome, load: Load, poses: Sequence[RobotPose]) -> None:
    names = list(load.bodies)
    for pose in poses:
        truth = load.paths.at((pose.t_ns - START_NS) * 1e-9).p[names.index(pose.robot)]
        error = np.subtract(pose.position, truth)
        P = np.frombuffer(pose.covariance, "<f4").reshape(12, 12)[3:6, 3:6].astype(float)
        outcome.poses.append(pose)
        outcome.errors_m.append(float(np.linalg.norm(error)))
        outcome.sigmas.append(float(np.sqrt(error @ np.linalg.solve(P, error))))


class _Log(logging.Handler):
    """Collects the warnings with the time of the frame set."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[tuple[float, str]] = []
        self.now_s = 0.0

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append((self.now_s, record.getMessage()))
