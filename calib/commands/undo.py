# SPDX-License-Identifier: BSD-3-Clause
"""`calib undo`: the rig before the last calibration."""

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from calib.commands.output import say
from calib.history import undo
from calib.live import publish
from calib.rig import load_rig
from camera_node.network import open_client


@dataclass(frozen=True, kw_only=True)
class Undo:
    """Bring back the rig before the last calibration."""

    rig: Path
    """The rig to bring back; earlier ones lie beside it as rig.1.yaml, rig.2.yaml, ..."""
    live: bool = False
    """Hand it to the running server too."""
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Zenoh endpoints of the server."""
    arena: str = "arena"
    """The arena's name in the keys."""
    zenoh: Path | None = None
    """A Zenoh configuration of your own."""

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
            with open_client(self.connect, self.zenoh) as session:
                if not publish(session, self.arena, rig):
                    say(console, f"warning: nobody took the rig; give the server {self.rig}")
