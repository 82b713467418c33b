# SPDX-License-Identifier: BSD-3-Clause
"""Two processes' worth of robots: who is whose, and that no shard takes the other's detections."""

import contextlib
import threading

import msgspec
import numpy as np
import pytest

from camera_node.errors import ConfigError, NetworkError
from fusion.messages import RobotPose
from fusion.robots import Robot
from fusion.server import Server
from fusion.shards import Shard
from fusion.tracker import Limits
from tests.fusion.synthetic import TRIANGLE, WIDE, Arena, line
from tests.fusion.test_server import DEADLINE_S, config, live, send, serving, until

NAMES = [f"robot_{k}" for k in range(200)]


def test_every_robot_has_one_shard_whatever_the_others_are_called():
    shards = [Shard(k, 3) for k in (1, 2, 3)]
    owners = [[shard.owns(name) for shard in shards] for name in NAMES]
    assert all(sum(row) == 1 for row in owners)
    assert np.sum(owners, axis=0).min() > 200 / 3 - 4 * np.sqrt(200 * 2 / 9)  # as names fall, to 4 sigma
    assert Shard.parse("2/3") == shards[1]


@pytest.mark.parametrize("text", ["", "2", "0/2", "3/2", "1/65", "a/b", "-1/2"])
def test_what_is_no_shard_is_said(text):
    with pytest.raises(ConfigError, match="write it as 1/2"):
        Shard.parse(text)


def near(pose: RobotPose | None, place: tuple[float, float, float]) -> bool:
    return pose is not None and bool(np.abs(np.subtract(pose.position, place)).max() < 5e-3)


def test_two_shards_on_loopback_track_each_its_own(tmp_path):
    """Two constellations and a single marker of the other shard's close by; each pose comes from one shard, all are
    right once their speeds are known, and the leading shard labels the markers of both."""
    mine = next(name for name in NAMES if Shard(1, 2).owns(name))
    other = next(name for name in NAMES if Shard(2, 2).owns(name))
    single = [name for name in NAMES if Shard(2, 2).owns(name)][1]
    places = {mine: (-0.3, 0.1, 0.2), other: (0.3, -0.1, 0.2), single: (0.0, 0.4, 0.2)}
    robots = {mine: TRIANGLE, other: WIDE, single: Robot(diameter_m=0.12)}
    arena = Arena(robots, {name: line(at) for name, at in places.items()}, sigma_px=0.05)
    first = msgspec.structs.replace(config(tmp_path), shard="1/2", limits=Limits(lateness_ms=200))
    (tmp_path / "robots.yaml").write_bytes(msgspec.yaml.encode({"robots": msgspec.to_builtins(robots)}))
    with serving(first) as (server, client), Server(msgspec.structs.replace(first, shard="2/2")) as second:
        thread = threading.Thread(target=second.run)
        thread.start()
        try:
            streams = {name: client.robot(name, DEADLINE_S) for name in robots}
            markers = client.markers(DEADLINE_S)

            labels: set[int] = set()
            markers.on_message(lambda message: labels.update(message.robot_index().tolist()))

            def all_are_told() -> bool:
                """Frames of this moment, paced by the answer: the shards must keep hearing of each other."""
                send(server, live(arena.messages(1), ago_ns=0))
                with contextlib.suppress(NetworkError):
                    markers.next(0.04)
                return all(near(s.latest(), places[name]) for name, s in streams.items()) and labels >= {
                    0,
                    1,
                    2,
                }

            until(all_are_told)
            assert server._tracker is not None
            assert second._tracker is not None
            assert server._tracker.owned.tolist() == [True, False, False]
            assert second._tracker.owned.tolist() == [False, True, True]
        finally:
            second.stop()
            thread.join(DEADLINE_S)
