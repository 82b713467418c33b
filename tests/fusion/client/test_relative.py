# SPDX-License-Identifier: BSD-3-Clause
"""A robot's camera locates roundels without a server, and the robot's programs receive the positions."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from camera_node.foundation.errors import ConfigError, NetworkError
from camera_node.protocol.messages import encode
from camera_node.protocol.session import open_router
from fusion.client import Arena
from tests.camera_node.node.picture import CENTRE, render
from tests.camera_node.protocol.positions import pack_random
from tests.conftest import free_port
from tests.waiting import wait_for

LENS = {"width": 320, "height": 240, "fx": 300.0, "fy": 300.0, "cx": 159.5, "cy": 119.5}
DIAMETER_M = 0.1


@pytest.fixture
def options(tmp_path: Path) -> list[str]:
    """Of a robot's camera that plays 60 s of pictures of one roundel."""
    folder = tmp_path / "frames"
    folder.mkdir()
    cv2.imwrite(str(folder / "0.png"), render())
    for k in range(1, 1200):
        (folder / f"{50_000_000 * k}.png").symlink_to(folder / "0.png")
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump({"cameras": {"scout": LENS}}))
    lens = ["--rig", str(tmp_path / "rig.yaml"), "--diameter", str(DIAMETER_M)]
    return ["--source", str(folder), "--name", "scout", "--arena", "swarm", "--stamps", "now", *lens]


@pytest.fixture
def robot(options: list[str], tmp_path: Path) -> Iterator[str]:
    """The endpoint of that robot, without any server."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "web.roundel.command", "camera", *options, "--listen", endpoint]
    with (tmp_path / "log").open("wb") as log, subprocess.Popen(command, stdout=log, stderr=log) as child:
        yield endpoint
        child.terminate()
        assert child.wait(20) == 0, (tmp_path / "log").read_text()
    assert "the server is away" not in (tmp_path / "log").read_text()


def test_positions_of_a_robots_own_camera(robot: str):
    """The distance follows from the size in the picture, and the direction from its place, to 0.2 px."""
    with Arena.connect(robot, arena="swarm") as arena:
        stream = arena.relative("scout", timeout_s=60.0)
        messages = [message for message, _ in zip(stream, range(10), strict=False)]
        assert not arena.faults
    assert [m.seq for m in messages] == sorted({m.seq for m in messages})
    assert {(m.camera, m.diameter_m) for m in messages} == {("scout", DIAMETER_M)}
    assert all(np.isnan(m.clock_error_us) for m in messages), "there is no server"
    seen = messages[-1].unpack()
    assert len(seen) == 1
    x, y, z = seen.position[0]
    np.testing.assert_allclose([300 * x / z + LENS["cx"], 300 * y / z + LENS["cy"]], CENTRE, atol=0.2)
    assert seen.axis_distance[0] == pytest.approx(np.linalg.norm(seen.position[0]), rel=0.01)
    assert (seen.normals[0] @ seen.position[0] < 0).all()


def test_a_robot_without_a_camera_is_an_error_that_says_what_to_start():
    with Arena.connect(f"tcp/127.0.0.1:{free_port()}") as arena:
        with pytest.raises(NetworkError, match="roundel camera --rig RIG --diameter METRES"):
            arena.relative("scout", timeout_s=0.1).next()
        with pytest.raises(ConfigError):
            arena.relative("*")


def test_messages_under_another_cameras_key_are_counted():
    """They are faults; so are invalid bytes."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_router([endpoint]) as router, Arena.connect(endpoint) as arena:
        stream, key = arena.relative("scout"), arena.keys.relative("scout")
        for data in (encode(pack_random(2, "other")), b"invalid"):
            before = arena.faults["RelativePositions"]
            wait_for(lambda: arena.faults["RelativePositions"] > before, lambda: router.put(key, data))  # noqa: B023
        assert stream.latest() is None
        wait_for(stream.latest, lambda: router.put(key, encode(pack_random(2, "scout"))))


@pytest.mark.parametrize(
    ("program", "extra", "says"),
    [
        (["web.roundel.command", "camera"], ["--connect", "tcp/127.0.0.1:1"], "give it or --connect"),
        (["camera_node"], ["--diameter", "20"], "the diameter is 20"),
        (["camera_node"], ["--name", "north"], "has no camera 'north'; it has scout"),
    ],
)
def test_mistakes_are_one_line(options: list[str], program: list[str], extra: list[str], says: str):
    command = [sys.executable, "-m", *program, *options, "--listen", "tcp/127.0.0.1:0", *extra]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
