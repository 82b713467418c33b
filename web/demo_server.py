# SPDX-License-Identifier: BSD-3-Clause
"""Starts the demo's fusion server. The server itself takes its port, so that no other program can take it before."""

import time
from dataclasses import dataclass
from pathlib import Path

from web.errors import WebError
from web.processes import Processes, ProgramFailed

USUAL, ANY_PORT = "tcp/127.0.0.1:7447", "tcp/127.0.0.1:0"  # the README's client connects to the usual port
START_TIMEOUT_S = 120.0
POLL_S = 0.02


@dataclass(frozen=True)
class RunningServer:
    """A server that listens.

    Attributes:
        endpoint: the Zenoh endpoint for clients.
        startup_s: time from its start until it listened.
    """

    endpoint: str
    startup_s: float


def start_server(processes: Processes, config: Path, listen: str | None = None) -> RunningServer:
    """Start `python -m fusion` on an endpoint, or on the usual port, or if that is taken on any free port.

    Args:
        processes: runs the server under the name "fusion".
        config: the arena's configuration.
        listen: the endpoint; its port may be 0, for any free port.

    Raises:
        WebError: the endpoint is taken, or a configuration file is invalid.
        ProgramFailed: the server ended in another way, or did not listen in time.
    """
    if listen is not None:
        return _start_server_on(listen, processes, config)
    try:
        return _start_server_on(USUAL, processes, config)
    except WebError as error:
        if USUAL not in str(error):  # a fault in a file
            raise
        return _start_server_on(ANY_PORT, processes, config)


def _start_server_on(listen: str, processes: Processes, config: Path) -> RunningServer:
    path, start = processes.folder / "endpoints", time.monotonic()
    path.unlink(missing_ok=True)
    processes.start(
        "fusion", "fusion", ["--config", str(config), "--listen", listen, "--endpoints-file", str(path)]
    )
    while not path.exists():
        processes.check()
        if time.monotonic() - start > START_TIMEOUT_S:
            raise ProgramFailed(f"the server did not listen on {listen} within {START_TIMEOUT_S:.0f} s")
        time.sleep(POLL_S)
    return RunningServer(path.read_text().splitlines()[0], time.monotonic() - start)
