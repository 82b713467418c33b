# SPDX-License-Identifier: BSD-3-Clause
"""The running arena, as the subcommands reach it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from zenoh import Session

from calib.commands.output import say
from calib.live.collect import publish
from calib.rig.rig import Rig
from camera_node.protocol.session import open_client


@dataclass(frozen=True, kw_only=True)
class Connection:
    """The running server and cameras, for --live."""

    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Zenoh endpoints of the server."""
    arena: str = "arena"
    """The arena's name in the keys."""
    zenoh: Path | None = None
    """A Zenoh configuration of your own."""

    def open(self) -> Session:
        """A session; it keeps trying to reach the server."""
        return open_client(self.connect, self.zenoh)

    def hand_over(self, rig: Rig, file: Path, console: Console) -> None:
        """Give the server the rig that was written to `file`, or say that nobody took it."""
        with self.open() as session:
            taken = publish(session, self.arena, rig)
        if not taken:
            say(console, f"warning: nobody took the rig; give the server {file}")


Server = Annotated[Connection, tyro.conf.arg(name="")]
