# SPDX-License-Identifier: BSD-3-Clause
"""The fault family of the viewer and the demo."""

from camera_node.errors import RoundelError


class WebError(RoundelError):
    """A viewer or a demo that can't run here: a port that is taken, a program of the arena that stopped."""
