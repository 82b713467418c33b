# SPDX-License-Identifier: BSD-3-Clause
"""What a client reports when no pose arrives: the cause, with names that are there. Its advice, followed, works."""

import re
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from calib.rig.rig import Rig
from camera_node.foundation.errors import NetworkError
from camera_node.protocol.server_connection import Connection
from fusion.client.arena import Arena
from fusion.commands.health import health
from fusion.protocol.arena_health import why_no_markers, why_no_poses
from fusion.protocol.pose_messages import CameraHealth, FusionStatus
from fusion.server.server import Server
from tests.conftest import free_port
from tests.fusion.serving import ARENA, config, later, send, send_until_tracked, serving
from tests.messages import HEALTH, STATUS
from tests.waiting import DEADLINE_S, wait_for

SILENT = msgspec.structs.replace(HEALTH, fps=0.0)
NEW = msgspec.structs.replace(HEALTH, calibrated=False)
ROBOTS = {"rover": "tracked", "drone": "coasting"}


def status(cameras: dict[str, CameraHealth], robots: dict, not_acquired: dict[str, str]) -> FusionStatus:
    return msgspec.structs.replace(STATUS, cameras=cameras, robots=robots, not_acquired=not_acquired)


@pytest.mark.parametrize(
    ("cameras", "robots", "not_acquired", "robot", "says"),
    [
        ({}, {}, {}, "rover", "no camera runs: start roundel camera on its machine"),
        ({"b": SILENT, "a": SILENT}, {}, {}, None, r"no camera sends frames \(a, b\): check"),
        ({"a": SILENT}, ROBOTS, {}, "rovr", r"no robot 'rovr', but drone, rover; did you mean rover\?"),
        ({"a": HEALTH}, ROBOTS, {}, "cart", r"no robot 'cart', but drone, rover$"),
        (
            {"a": SILENT, "b": NEW},
            ROBOTS,
            {},
            "rover",
            r"frames is calibrated \(b\): run roundel calibrate wand",
        ),
        ({"a": HEALTH}, {}, {}, "rover", "no robot is declared: use roundel define"),
        ({"a": HEALTH}, {}, {"cart": "2 of 3 seen"}, "cart", "robot cart is not found: 2 of 3 seen"),
        ({"a": HEALTH}, ROBOTS, {}, "drone", "robot drone is coasting: are its markers in view"),
        ({"a": HEALTH}, ROBOTS, {}, "rover", "^$"),
        ({"a": HEALTH}, ROBOTS, {}, None, "^$"),
    ],
)
def test_the_cause_is_the_first_thing_that_is_missing(cameras, robots, not_acquired, robot, says):
    """Misspelling, cameras, calibration, robots, in this order; nothing where poses are sent."""
    assert re.search(says, why_no_poses(status(cameras, robots, not_acquired), robot))


def test_markers_need_no_robot():
    assert why_no_markers(status({"a": HEALTH}, {}, {})) == ""


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Server, Arena]]:
    """A server of the arena "test" with the robot "a", and a client."""
    with serving(config(tmp_path_factory.mktemp("arena"))) as both:
        yield both


def cause_of(arena: Arena, robot: str, word: str) -> str:
    """The error's text once the client knows enough to name `word`: tokens and a status arrive after it connects."""

    def text() -> str:
        with pytest.raises(
            NetworkError, match=f"no pose of '{robot}' from arena .* within 0.01 s; "
        ) as error:
            arena.robot(robot).next(0.01)
        return str(error.value)

    return wait_for(lambda: found if word in (found := text()) else "")


def test_a_misspelt_robot_is_answered_with_the_one_that_was_meant(served: tuple[Server, Arena]):
    server, client = served
    (meant,) = re.findall(
        r"there is no robot 'aa', but a; did you mean (\w+)\?", cause_of(client, "aa", "did you mean")
    )
    send_until_tracked(server, client, ARENA.messages(30))
    assert client.robot(meant).latest() is not None


def test_another_arena_is_answered_with_the_one_that_is_there(served: tuple[Server, Arena], capsys):
    """By the client, and by `roundel health`, which then succeeds with the arena that it names."""
    server, _ = served
    with Arena.connect(*server.endpoints, arena="tset") as client:
        (named,) = re.findall(
            r"no arena 'tset', but test; did you mean test\?; give --arena (\w+) ",
            cause_of(client, "a", "--arena"),
        )
        assert f'(arena="{named}" in Python)' in client.why_no_poses("a")
    with pytest.raises(
        NetworkError, match=f"no status from arena 'demo' .*but {named}; give --arena {named} "
    ):
        health(connection=Connection(connect=server.endpoints, arena="demo"), timeout_s=2.0)
    health(connection=Connection(connect=server.endpoints, arena=named), timeout_s=DEADLINE_S)
    assert "robots tracked" in capsys.readouterr().out


def test_a_server_without_cameras_or_calibration_says_so(tmp_path: Path):
    """Once frames arrive, and the server has a calibration, it sends poses."""
    messages = ARENA.messages(30)
    with serving(config(tmp_path, with_rig=False)) as (server, client):
        cause_of(client, "a", "no camera runs: start roundel camera")
        wait_for(
            lambda: "frames is calibrated (" in client.why_no_poses("a"),
            lambda: send(server, later(messages)),
        )
        client.set_rig(Rig(cameras=ARENA.cameras))
        send_until_tracked(server, client, messages)


def test_an_absent_server_is_named_and_a_server_that_starts_there_answers(tmp_path: Path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Arena.connect(endpoint, arena="test") as client:
        assert "no server answers there: start it with roundel up or roundel server" in client.why_no_poses(
            "a"
        )
        with Server(msgspec.structs.replace(config(tmp_path), listen=(endpoint,))):
            wait_for(lambda: "no server answers" not in client.why_no_poses("a"))
        wait_for(lambda: "no server answers" in client.why_no_poses("a"))
