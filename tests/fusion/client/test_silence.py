# SPDX-License-Identifier: BSD-3-Clause
"""What a client reports when no pose arrives: a misspelt name is not a missing server."""

import pytest

from camera_node.errors import NetworkError
from fusion.client.streams import RobotStream


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
