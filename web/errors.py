# SPDX-License-Identifier: BSD-3-Clause
"""The exception of the viewer and the demo."""

from camera_node.foundation.errors import TEMPORARY_FAILURE, RoundelError


class WebError(RoundelError):
    """The viewer or the demo cannot run on this machine: a port is taken, or a program of the arena stopped."""


class PortError(WebError):
    """The page's address is taken, or its network is not up."""

    exit_code = TEMPORARY_FAILURE
