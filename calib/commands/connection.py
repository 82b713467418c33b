# SPDX-License-Identifier: BSD-3-Clause
"""The options by which subcommands reach the running arena."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from zenoh import Session

from calib.live.collect import publish_rig
from calib.rig.rig import Rig
from camera_node.protocol.session import open_client
from camera_node.terminal import say


@dataclass(frozen=True, kw_only=True)
class Connection:
    """The running server and cameras, for --live."""

    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Zenoh endpoints of the server."""
    arena: str = "arena"
    """The arena's name in the keys."""
    zenoh: Path | None = None
    """A Zenoh configuration file."""

    def open(self) -> Session:
        """Open a session; it keeps trying to reach the server."""
        return open_client(self.connect, self.zenoh)

    def publish(self, rig: Rig, file: Path) -> None:
        """Publish the rig that was written to `file`; print a warning if no server received it."""
        with self.open() as session:
            received = publish_rig(session, self.arena, rig)
        if not received:
            say(f"warning: no server received the rig; give the server {file}")


Server = Annotated[Connection, tyro.conf.arg(name="")]
