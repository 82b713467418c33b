# SPDX-License-Identifier: BSD-3-Clause
"""The options by which commands reach the server of an arena."""

from dataclasses import dataclass
from pathlib import Path

LOCAL = ("tcp/127.0.0.1:7447",)


@dataclass(frozen=True, kw_only=True)
class ServerAddress:
    """The arena's server."""

    connect: tuple[str, ...] = LOCAL
    """Zenoh endpoints of the server."""
    arena: str = "arena"
    """The arena's name."""
    zenoh: Path | None = None
    """A Zenoh configuration (JSON5) for TLS, access control or scouting."""
