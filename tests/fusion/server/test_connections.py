# SPDX-License-Identifier: BSD-3-Clause
"""The server bounds the connections of each address."""

import contextlib
from pathlib import Path

from camera_node.protocol.session import open_client
from fusion.server.server import MAX_OF_ADDRESS
from tests.fusion.serving import config, serving
from tests.waiting import DEADLINE_S, wait_for

FAULT = "connections beyond the limit of one address"


def test_silent_sessions_of_one_client_are_ended_by_the_server(tmp_path: Path):
    """They exclude no other machine: the connection of another address stays."""
    with serving(config(tmp_path)) as (server, client), contextlib.ExitStack() as stack:
        endpoint = f"{server.endpoints[0]}#bind=127.0.0.3:0"
        for _ in range(MAX_OF_ADDRESS + 5):
            stack.enter_context(open_client([endpoint], timeout_s=DEADLINE_S))
        assert wait_for(lambda: client.status(DEADLINE_S).next().faults.get(FAULT, 0)) >= 5
