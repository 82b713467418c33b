# SPDX-License-Identifier: BSD-3-Clause
"""Messages of an arena in which nothing is wrong, of which tests replace what they are about."""

from camera_node.protocol.messages import CameraStatus
from fusion.protocol.pose_messages import CameraHealth, FusionStatus

NODE = CameraStatus(
    camera="north",
    t_ns=0,
    width=640,
    height=480,
    fps=30.0,
    frames=100,
    dropped=0,
    detect_ms=0.7,
    roundels=8.0,
    saturated=0.0,
)
HEALTH = CameraHealth(
    fps=30.0, lateness_ms=5.0, residual_px=None, assigned=0, unassigned=0, late=0, calibrated=True
)
STATUS = FusionStatus(
    t_ns=0,
    frame_sets_per_s=30.0,
    latency_ms=None,
    cpu=0.1,
    memory_mb=100.0,
    cameras={},
    robots={},
    faults={},
)
