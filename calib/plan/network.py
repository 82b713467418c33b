# SPDX-License-Identifier: BSD-3-Clause
"""Rate and network load of an arena, from the size of the messages that its cameras publish."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np

from calib.plan.description import PlannedRobots
from camera_node.detection.roundels import Roundels
from camera_node.protocol.messages import Detections, encode

PACKET_BYTES = 90  # Ethernet, IP and TCP headers and the frame of a Zenoh message, about
BUSY = 100e6  # bit/s: more needs a wired gigabit network


@dataclass(frozen=True, slots=True)
class NetworkLoad:
    """What the cameras send to the server.

    Attributes:
        camera_bit_s: by camera, if robots are everywhere with the same probability, bit/s.
        total_bit_s: of all cameras.
        slowest_hz, fastest_hz: frame rates; poses are computed for each frame set, at about the fastest of them.
        detections_s: detections of all cameras in a second.
    """

    camera_bit_s: Mapping[str, float]
    total_bit_s: float
    slowest_hz: float
    fastest_hz: float
    detections_s: float


def network_load(robots: PlannedRobots, fps: Mapping[str, float], shares: Mapping[str, float]) -> NetworkLoad:
    """The load of cameras with frame rates `fps`, which see these `shares` of the volume, both by name."""
    n = robots.count * len(robots.markers)
    load = {name: 8 * rate * message_bytes(n * shares[name]) for name, rate in fps.items()}
    detections = sum(rate * n * shares[name] for name, rate in fps.items())
    rates = list(fps.values()) or [0.0]
    return NetworkLoad(load, sum(load.values()), min(rates), max(rates), detections)


def message_bytes(n: float) -> float:
    """Bytes of one message with n roundels on the network; linear in n, by the encoder of the camera node."""
    empty, ten = (_encoded_bytes(k) for k in (0, 10))
    return PACKET_BYTES + empty + (ten - empty) / 10 * n


@cache
def _encoded_bytes(n: int) -> int:
    roundels = Roundels.from_points(np.zeros((n, 2)), 0.1)
    stamp = 1_800_000_000_000_000_000
    message = Detections.pack(
        roundels, camera="camera-1", seq=10**6, t_ns=stamp, sent_ns=stamp, width=1920, height=1080
    )
    return len(encode(message))
