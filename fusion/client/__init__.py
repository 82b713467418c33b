# SPDX-License-Identifier: BSD-3-Clause
"""The public import of programs that read poses: `from fusion.client import Arena`."""

from fusion.client.arena import Arena, Robot, Stream

__all__ = ["Arena", "Robot", "Stream"]
