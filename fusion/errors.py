# SPDX-License-Identifier: BSD-3-Clause
"""The fault family of fusion."""

from camera_node.errors import RoundelError


class FusionError(RoundelError):
    """Robots or an arena that can't be tracked as they are configured."""
