# SPDX-License-Identifier: BSD-3-Clause
"""The public interface for programs that read poses: `from fusion.client import Arena`."""

from fusion.client.arena import Arena
from fusion.client.streams import RobotStream, Stream

__all__ = ["Arena", "RobotStream", "Stream"]
