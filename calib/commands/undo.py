# SPDX-License-Identifier: BSD-3-Clause
"""`calib undo`: restores the previous rig."""

from dataclasses import dataclass, field
from pathlib import Path

from calib.commands.connection import Connection, Server
from calib.rig.history import undo
from calib.rig.rig import load_rig
from camera_node.terminal import say


@dataclass(frozen=True, kw_only=True)
class Undo:
    """Restore the rig from before the last calibration."""

    rig: Path
    """The rig to restore; earlier rigs are beside it as rig.1.yaml, rig.2.yaml, ..."""
    live: bool = False
    """Publish it to the running server too."""
    server: Server = field(default_factory=Connection)

    def execute(self) -> None:
        """Swap the files, and publish the restored rig."""
        backup, undone = undo(self.rig)
        rig = load_rig(self.rig)
        date = rig.calibration.get("date")
        made = f"made at {date}" if date else "no date recorded"
        say(f"restored {self.rig} from {backup.name} ({made}); the undone rig is saved as {undone.name}")
        if self.live:
            self.server.publish(rig, self.rig)
