# SPDX-License-Identifier: BSD-3-Clause
"""A connection opens whenever its server does, and requests find their queryables at once."""

import logging
import threading

import pytest

from camera_node.foundation.errors import ConfigError, NetworkError
from camera_node.protocol.server_connection import ServerConnection
from tests.waiting import DEADLINE_S


def test_actions_wait_for_the_server_and_then_run_at_once(network):
    connection, opened, called = network.connection(), threading.Event(), []
    connection.when_open(called.append)
    connection.when_open(lambda session: opened.set())
    with pytest.raises(NetworkError, match=f"no server answers at {network.endpoint} within 0.1 s"):
        connection.session(0.1)
    assert not called
    network.router_again()
    session = connection.session(10.0)
    assert opened.is_set()
    connection.when_open(called.append)
    assert called == [session, session]


def test_a_closed_connection_runs_no_action(network):
    """Its session opens later, in its thread, and is closed there."""
    connection, called = network.connection(), threading.Event()
    connection.when_open(lambda session: called.set())
    connection.close()
    network.router_again()
    assert connection.session(10.0).is_closed() or not called.is_set()
    assert not called.is_set()


def test_the_wait_ends_with_the_stop_event_or_with_an_exception(network):
    connection, stop = network.connection(), threading.Event()
    stop.set()
    assert connection.wait_unless(stop) is None

    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        connection.wait_unless(threading.Event(), interrupt)


def test_the_absence_of_the_server_is_logged_once(network, caplog, monkeypatch):
    monkeypatch.setattr("camera_node.protocol.server_connection.PATIENCE_S", 0.0)
    caplog.set_level(logging.WARNING, "camera_node.network")
    looks = 0

    def look() -> None:
        nonlocal looks
        looks += 1
        if looks == 3:
            network.router_again()

    network.connection().wait_unless(threading.Event(), look)
    assert [record.getMessage().split(":")[0] for record in caplog.records] == [
        "the server is away",
        "the server is back",
    ]


def test_invalid_endpoints_and_configurations_are_refused_at_once(network, tmp_path):
    with pytest.raises(NetworkError, match="give an endpoint such as tcp/"):
        ServerConnection(["carrier-pigeon/roof:1"])
    with pytest.raises(NetworkError, match="give an endpoint such as tcp/"):
        ServerConnection([7447])  # pyright: ignore[reportArgumentType]: as users may
    with pytest.raises(ConfigError, match="does not exist"):
        ServerConnection([network.endpoint], tmp_path / "none.json5")


def test_a_session_that_opens_while_another_one_closes_finds_the_queryables(network):
    """Sessions in mode router that did so never found one (Zenoh 1.10)."""
    router = network.router()
    queryable = router.declare_queryable("a/q", lambda query: query.reply("a/q", b"answer"))
    for _ in range(20):
        other = ServerConnection([network.endpoint])
        closing = threading.Thread(target=other.close)
        closing.start()
        with ServerConnection([network.endpoint]) as connection:
            replies = connection.session(5.0).get("a/q", timeout=DEADLINE_S)
            assert [reply.ok.payload.to_string() for reply in replies if reply.ok] == ["answer"]
        closing.join(DEADLINE_S)
    queryable.undeclare()
