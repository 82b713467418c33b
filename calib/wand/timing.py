# SPDX-License-Identifier: BSD-3-Clause
"""How frames of different cameras are related in time: by equal stamps, or by clocks and the wand's motion."""

from dataclasses import dataclass

import numpy as np

from calib.wand.detections import FrameTable
from camera_node.foundation.arrays import Array, Index

MAX_GAP_PERIODS, MAX_GAP_S = 2.5, 0.5  # longest interpolation of a track: frame periods, and seconds
MAX_SPREAD_S = 0.1  # a hand moves decimetres in this time
MIN_SPREAD_S = (
    0.02  # frames this close form one set at any frame rate: the motion between them is interpolated
)
# Share of each camera's frames that share a stamp with another camera, from which cameras may be synchronous. Stamps of
# free-running cameras, rounded to milliseconds, coincide by chance for 40 % of the frames of eight cameras at 60 Hz.
MIN_COINCIDENT = 0.8


@dataclass(frozen=True, slots=True)
class Timing:
    """The relation of frames in time.

    Attributes:
        period_s: median time between the frames of a camera; 0 if unknown.
        synchronous: frames with equal stamps are simultaneous; all others are unrelated, so neither clocks nor the
            motion of the wand matter. Otherwise stamps may be offset, and tracks are interpolated in time.
    """

    period_s: float
    synchronous: bool = False

    @property
    def gap_s(self) -> float:
        """The longest time over which tracks and the wand's motion are interpolated; 0 for synchronous cameras."""
        if self.synchronous:
            return 0.0
        return min(MAX_GAP_PERIODS * self.period_s, MAX_GAP_S) if self.period_s else MAX_GAP_S

    @property
    def spread_s(self) -> float:
        """The longest time between the frames of one frame set: half a frame period, or 20 ms if that is longer."""
        if self.synchronous:
            return 0.0
        if not self.period_s:
            return MAX_SPREAD_S
        return min(max(self.period_s / 2, min(self.period_s, MIN_SPREAD_S)), MAX_SPREAD_S)

    def instants(self, t_s: Array) -> Index:
        """(n,) numbers of the instants at which stamps (n,) lie: of equal stamps, or of frame periods."""
        if self.synchronous or not self.period_s:
            return np.unique(t_s, return_inverse=True)[1]
        return np.floor((t_s - t_s.min(initial=np.inf)) / self.period_s).astype(np.intp)


def coincident_share(frames: FrameTable) -> float:
    """Return the share of frames whose stamp another camera's frame has too, of the camera with the smallest share."""
    _, instant, count = np.unique(frames.t_s, return_inverse=True, return_counts=True)
    shared = (count[instant] >= 2).astype(float)
    cameras = np.unique(frames.camera)
    return min(float(shared[frames.camera == camera].mean()) for camera in cameras)
