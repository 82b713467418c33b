# SPDX-License-Identifier: BSD-3-Clause
"""How many frames the server accepts from each camera, decided on arrival, before anything is decoded."""

import math
from collections.abc import Collection

from camera_node.foundation.rate_limit import RateLimit

FRAMES_PER_SET = 4.0  # accepted from one camera, on average: more than the synchronizer's FAR_FASTER
SLACK = 16  # frames that may arrive at once in addition to those of the lateness limit
UNCALIBRATED_HZ = 2000.0  # messages a second of all cameras together that the rig does not contain
UNCALIBRATED = "cameras without a pose"


class FrameQuotas:
    """A quota for each camera of the rig, and one for all other cameras together.

    Args:
        lateness_ms: how long a frame set waits: frames of that time may arrive at once.
        rate_hz: of the frame sets.
    """

    def __init__(self, lateness_ms: float, rate_hz: float) -> None:
        self._lateness_s = lateness_ms * 1e-3
        self._rate_hz = rate_hz
        self._others = RateLimit(UNCALIBRATED_HZ, UNCALIBRATED_HZ)
        self._cameras: dict[str, RateLimit] = {}

    @property
    def limit_hz(self) -> float:
        """Frames a second that one camera may send."""
        return FRAMES_PER_SET * self._rate_hz

    @property
    def burst(self) -> int:
        """Frames of one camera that may arrive at once, and wait in the queue."""
        return math.ceil(self.limit_hz * self._lateness_s) + SLACK

    def update(self, keys: Collection[str], rate_hz: float) -> None:
        """Set the keys of the rig's cameras and the rate of the frame sets."""
        self._rate_hz = rate_hz
        quotas = {key: self._cameras.get(key) or RateLimit(self.limit_hz, self.burst) for key in keys}
        for quota in quotas.values():
            quota.rate_hz, quota.burst = self.limit_hz, self.burst
        self._cameras = quotas  # replaced as a whole: `admit` runs on Zenoh's threads

    def sender_of(self, key: str) -> str:
        """The sender of a frame on this key."""
        return key if key in self._cameras else UNCALIBRATED

    def admits(self, sender: str) -> bool:
        """Whether another frame of the sender is within its quota."""
        return self._cameras.get(sender, self._others).passes()
