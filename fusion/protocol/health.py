# SPDX-License-Identifier: BSD-3-Clause
"""What an arena's status means for an operator: one line, and what needs attention."""

from fusion.protocol.messages import FusionStatus


def describe_status(status: FusionStatus) -> str:
    """The server's cameras, robots and rate in one line."""
    live = sum(camera.fps > 0 for camera in status.cameras.values())
    tracked = sum(state == "tracked" for state in status.robots.values())
    return (
        f"{live} of {len(status.cameras)} cameras, {tracked} of {len(status.robots)} robots tracked, "
        f"{status.frame_sets_per_s:.0f} poses/s, {sum(status.faults.values())} faults"
    )
