# SPDX-License-Identifier: BSD-3-Clause
"""Fixture: a Viser server of its own."""

from collections.abc import Iterator

import pytest
import viser

from tests.conftest import free_port


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = viser.ViserServer(host="127.0.0.1", port=free_port(), verbose=False)
    yield server
    server.stop()
