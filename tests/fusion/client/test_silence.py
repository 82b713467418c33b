# SPDX-License-Identifier: BSD-3-Clause
"""What a client reports when no pose arrives: a misspelt name is not a missing server."""

from collections.abc import Iterator

import pytest

from camera_node.foundation.errors import NetworkError
from camera_node.protocol.server_connection import ServerConnection
from fusion.client.streams import RobotStream, cause_of_silence
from tests.conftest import free_port
from tests.fusion.serving import config, serving
from tests.waiting import wait_for


@pytest.mark.parametrize(
    ("name", "known", "says"),
    [
        ("rovr", {"rover", "drone"}, "the arena has no such robot, but drone, rover; did you mean rover?"),
        ("cart", {"rover", "drone"}, "the arena has no such robot, but drone, rover$"),
        ("rover", {"rover", "drone"}, "is roundel server"),
        ("rover", set(), "is roundel server"),
    ],
)
def test_a_misspelt_robot_is_answered_with_those_that_exist(name: str, known: set[str], says: str):
    """The names are those whose poses arrived by then."""
    stream = RobotStream(name, "from arena 'lab' at tcp/host:7447", 0.01, known)
    with pytest.raises(
        NetworkError,
        match=rf"no pose of '{name}' from arena 'lab' .* within 0.01 s; .*{says}".replace("?", r"\?"),
    ):
        stream.next()


@pytest.fixture(scope="module")
def connection_to_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerConnection]:
    """To a server of the arena "test" with the robot "a", which gets no frames."""
    with serving(config(tmp_path_factory.mktemp("arena"))) as (_, client):
        yield client.connection


@pytest.mark.parametrize(
    ("arena", "robot", "says"),
    [
        ("tset", None, "the arena there is test: give --arena test"),
        ("test", "aa", "the arena has no such robot, but a; did you mean a?"),
        ("test", "a", "the server runs, and its robots are a; do its cameras run?"),
    ],
)
def test_a_bridge_without_poses_says_why(
    connection_to_server: ServerConnection, arena: str, robot: str | None, says: str
):
    wait_for(lambda: cause_of_silence(connection_to_server, arena, robot) == says)


def test_a_bridge_without_a_server_says_so():
    with ServerConnection((f"tcp/127.0.0.1:{free_port()}",)) as connection:
        assert cause_of_silence(connection, "test") == "is roundel server running there?"
