# SPDX-License-Identifier: BSD-3-Clause
"""A recording without a message is reported."""

from pathlib import Path

import pytest

from camera_node.protocol.server_connection import Connection
from fusion.commands.record import record


def test_an_empty_recording_is_reported(tmp_path: Path, endpoint: str, capsys: pytest.CaptureFixture[str]):
    """No server is there: the exit code is 1, and the last line says why the file is empty."""
    assert record(tmp_path / "x.mcap", connection=Connection(connect=(endpoint,)), seconds=0.2) == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == f"warning: the recording is empty: no message of arena 'arena' arrived from {endpoint}"
