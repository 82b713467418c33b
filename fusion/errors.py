# SPDX-License-Identifier: BSD-3-Clause
"""The errors of fusion."""

from camera_node.foundation.errors import RoundelError


class FusionError(RoundelError):
    """Robots or an arena can't be tracked as configured."""
