# SPDX-License-Identifier: BSD-3-Clause
"""`roundel calibrate apply`: has the running server use a rig file."""

from dataclasses import dataclass
from pathlib import Path

from calib.commands.output import put_in_force
from calib.rig.rig import load_rig
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions


@dataclass(frozen=True, kw_only=True)
class Apply:
    """Have the running server use a rig, at once and after a restart."""

    rig: Path
    """The rig, such as one that roundel calibrate wand wrote without --live."""
    connection: ConnectionOptions = LOCAL_SERVER

    def run(self) -> None:
        """Hand the rig to the server."""
        put_in_force(self.connection, load_rig(self.rig), self.rig, "roundel calibrate apply")
