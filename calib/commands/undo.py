# SPDX-License-Identifier: BSD-3-Clause
"""`calib undo`: the rig before the last calibration."""

from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console

from calib.commands.connection import Connection, Server
from calib.commands.output import say
from calib.rig.history import undo
from calib.rig.rig import load_rig


@dataclass(frozen=True, kw_only=True)
class Undo:
    """Bring back the rig before the last calibration."""

    rig: Path
    """The rig to bring back; earlier ones lie beside it as rig.1.yaml, rig.2.yaml, ..."""
    live: bool = False
    """Hand it to the running server too."""
    server: Server = field(default_factory=Connection)

    def execute(self, console: Console) -> None:
        """Swap the files, and publish what is then in force."""
        kept, undone = undo(self.rig)
        rig = load_rig(self.rig)
        date = rig.calibration.get("date", "a date it does not tell")
        say(
            console,
            f"{self.rig} is again {kept.name}, made at {date}; the undone one is kept as {undone.name}",
        )
        if self.live:
            self.server.hand_over(rig, self.rig, console)
