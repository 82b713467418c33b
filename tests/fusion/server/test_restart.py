# SPDX-License-Identifier: BSD-3-Clause
"""A server that is killed and started again goes on with the saved rig and robots; nodes and clients reconnect."""

import math
import time
from pathlib import Path

from fusion.client.arena import Arena as Client
from tests.fusion.arena_process import cameras_at, saving
from tests.fusion.serving import ServerProcess
from tests.fusion.synthetic import WIDE
from tests.processes import run_program
from tests.waiting import Inbox, slowness

RETURN_S = 1.0  # after the server listens again, until all poses are back


def test_poses_return_after_the_server_was_killed(tmp_path: Path):
    """Robot b was defined over the network, so only the saved robots have it."""
    with (
        ServerProcess(saving(tmp_path)) as server,
        Client.connect(server.endpoint, arena="test") as client,
        cameras_at(server.endpoint),
    ):
        poses = Inbox()
        client.poses().on_message(lambda pose: poses.put((time.monotonic(), pose)))

        def tracked_between(begin_s: float, end_s: float = math.inf) -> set[str]:
            return {p.robot for t, p in poses.items if begin_s < t <= end_s and p.state == "tracked"}

        client.change_robots(define={"b": WIDE})
        assert poses.until(lambda _: tracked_between(0.0) == {"a", "b"})
        server.kill()
        began_s = time.monotonic()
        server.start()
        listens_s = time.monotonic()
        assert poses.until(lambda _: tracked_between(began_s) == {"a", "b"})
        first_s = min(t for t, _ in poses.items if tracked_between(began_s, t) == {"a", "b"})
        assert first_s - listens_s < RETURN_S * slowness()


def test_a_second_server_on_a_folder_ends_and_names_the_first(tmp_path: Path):
    """And changes nothing: the first one goes on, and what it saved stays."""
    with ServerProcess(saving(tmp_path)) as server, Client.connect(server.endpoint, arena="test") as client:
        client.change_robots(define={"b": WIDE})
        saved = (tmp_path / "robots.saved.yaml").read_bytes()
        settings = (tmp_path / "arena.yaml").read_text().replace(server.endpoint, "tcp/127.0.0.1:0")
        (tmp_path / "second.yaml").write_text(settings)
        second = run_program("fusion", "--config", tmp_path / "second.yaml")
        assert second.returncode == 2
        assert f"another server saves in {tmp_path}: process {server.process.pid} on " in second.stderr
        assert second.stderr.count("\n") == 1
        assert (tmp_path / "robots.saved.yaml").read_bytes() == saved
        assert set(client.declared_robots().robots) == {"a", "b"}
