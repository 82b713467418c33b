# SPDX-License-Identifier: BSD-3-Clause
"""Accuracy relative to the truth, and to the same filter with known associations."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fusion.model.frames import FrameSet
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.tracker import Tracker
from tests.benchmarks.fusion_load import START_NS, Load
from tests.fusion.known_filter import KnownFilter
from tests.fusion.synthetic import precise

START = 20  # frame sets for acquisition and for the velocities to converge


@dataclass(frozen=True)
class Accuracy:
    """RMS position errors in mm: of the tracker, of a filter with known associations, and from its covariance.

    `honesty` is the mean squared Mahalanobis error of the tracker's poses over their 6 degrees of freedom.
    `velocity_mm_s` is the RMS error of the tracker's velocities, `velocity_honesty` that over their claims.
    """

    tracker_mm: float
    known_mm: float
    bound_mm: float
    honesty: float
    tracked: float
    velocity_mm_s: float
    velocity_honesty: float


def accuracy(load: Load, seconds: float) -> Accuracy:
    """Of all robots in all frame sets after the start."""
    cameras = precise(load.rig)
    tracker = Tracker(cameras, load.bodies)
    tracker.table.markers.frame[:] = 0.0  # of robots that are measured as precisely as the cameras
    known = KnownFilter(cameras, load.bodies, lambda t_ns: load.paths.at((t_ns - START_NS) * 1e-9))
    mine, theirs, variance, honesty, tracked = [], [], [], [], []
    velocity, velocity_honesty = [], []
    for k, frame_set in enumerate(frame_sets(load, seconds)):
        tracker.track(frame_set)
        known.update(frame_set)
        if k < START:
            continue
        truth = load.paths.at((frame_set.t_ns - START_NS) * 1e-9)
        alive = tracker.table.tracked
        tracked.append(alive.mean())
        error = tracker.table.states.p - truth.p
        mine.append(np.sum(error[alive] ** 2, 1))
        off, P = (tracker.table.states.v - truth.v)[alive], tracker.table.claimed[alive, 9:, 9:]
        velocity.append(np.sum(off**2, 1))
        velocity_honesty.append(np.sum(off * np.linalg.solve(P, off[..., None])[..., 0], 1))
        theirs.append(np.sum((known.states.p - truth.p) ** 2, 1))
        variance.append(np.einsum("nii->n", known.states.P[:, 3:6, 3:6]))
        honesty.append(_mahalanobis(tracker.table.states.R, truth.R, error, tracker.table.claimed)[alive])
    rms = [1e3 * float(np.sqrt(np.mean(np.concatenate(x)))) for x in (mine, theirs, variance)]
    return Accuracy(
        rms[0],
        rms[1],
        rms[2],
        float(np.mean(np.concatenate(honesty)) / 6),
        float(np.mean(tracked)),
        1e3 * float(np.sqrt(np.mean(np.concatenate(velocity)))),
        float(np.mean(np.concatenate(velocity_honesty)) / 3),
    )


def frame_sets(load: Load, seconds: float) -> Iterator[FrameSet]:
    """The complete frame sets of a load, in order."""
    synchronizer, first = FrameSynchronizer(round(1e9 / load.hz)), True
    for frame in load.frames(seconds):
        synchronizer.add(frame)
        for frame_set in synchronizer.take(frame.t_ns):
            if not first:
                yield frame_set
            first = False


def _mahalanobis(R: np.ndarray, truth: np.ndarray, error: np.ndarray, P: np.ndarray) -> np.ndarray:
    """(N,) squared pose errors in standard deviations."""
    E = truth.transpose(0, 2, 1) @ R
    turn = np.stack([E[:, 2, 1] - E[:, 1, 2], E[:, 0, 2] - E[:, 2, 0], E[:, 1, 0] - E[:, 0, 1]], 1) / 2
    e = np.concatenate([turn, error], 1)
    return np.einsum("ni,ni->n", e, np.linalg.solve(P[:, :6, :6], e[:, :, None])[:, :, 0])
