# SPDX-License-Identifier: BSD-3-Clause
"""`calib apply`: has the running server use a rig file."""

from dataclasses import dataclass, field
from pathlib import Path

from calib.commands.connection import Connection, Server
from calib.rig.rig import load_rig


@dataclass(frozen=True, kw_only=True)
class Apply:
    """Have the running server use a rig, at once and after a restart."""

    rig: Path
    """The rig, such as one that `calib wand` wrote without --live."""
    server: Server = field(default_factory=Connection)

    def execute(self) -> None:
        """Hand the rig to the server."""
        self.server.put_in_force(load_rig(self.rig), self.rig, "calib apply")
