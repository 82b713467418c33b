# SPDX-License-Identifier: BSD-3-Clause
"""The options by which subcommands reach the running arena, and the hand-over of a rig to its server."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from zenoh import Session

from calib.live.rig_requests import set_rig
from calib.rig.rig import Rig
from camera_node.foundation.errors import NetworkError
from camera_node.foundation.terminal import say
from camera_node.protocol.requests import RequestError
from camera_node.protocol.server_connection import LOCAL, ServerAddress
from camera_node.protocol.session import open_client


@dataclass(frozen=True, kw_only=True)
class Connection(ServerAddress):
    """The running server and cameras, for --live."""

    def open(self) -> Session:
        """Open a session; it keeps trying to reach the server."""
        return open_client(self.connect, self.zenoh)

    def put_in_force(self, rig: Rig, file: Path, program: str) -> None:
        """Have the server use the rig that `file` holds, and print that it does.

        Args:
            rig: the rig.
            file: its file, for the error message.
            program: the name of the command, which the server reports.

        Raises:
            RequestError: the server refuses it, with its reason.
            NetworkError: no server answers in time.
        """
        try:
            with open_client(self.connect, self.zenoh) as session:
                in_force = set_rig(session, self.arena, rig, program)
        except RequestError as error:
            raise RequestError(f"the rig in {file} is not in force; the server refuses it: {error}") from None
        except NetworkError as error:
            again = self._apply_command(file)
            raise NetworkError(f"the rig in {file} is not in force: {error}; then run {again}") from None
        lost = "" if in_force.saved else "; it saves no rig: start it with --rig next time"
        say(f"in force on the server at {' '.join(self.connect)}, arena '{self.arena}'{lost}")

    def conclude(self, rig: Rig, file: Path, program: str, *, live: bool) -> None:
        """With `live`, `put_in_force`; else print that the server was not contacted, and how to make it use the rig."""
        if live:
            self.put_in_force(rig, file, program)
        else:
            say(f"the server was not contacted; to use the rig there: {self._apply_command(file)}")

    def _apply_command(self, file: Path) -> str:
        words = ["python", "-m", "calib", "apply", "--rig", str(file)]
        if self.connect != LOCAL:
            words += ["--connect", *self.connect]
        if self.arena != Connection.arena:
            words += ["--arena", self.arena]
        if self.zenoh is not None:
            words += ["--zenoh", str(self.zenoh)]
        return shlex.join(words)


Server = Annotated[Connection, tyro.conf.arg(name="")]
