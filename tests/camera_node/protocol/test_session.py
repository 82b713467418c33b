# SPDX-License-Identifier: BSD-3-Clause
"""Zenoh sessions find the router, reconnect after its loss, and the router relays between them."""

import logging
import re
import threading
from pathlib import Path

import pytest
import zenoh

from camera_node.foundation.errors import ConfigError, NetworkError
from camera_node.protocol.messages import MAX_BYTES
from camera_node.protocol.requests import send_request
from camera_node.protocol.session import (
    BURST_BUFFER,
    MAX_MESSAGE,
    SEND_BUFFER,
    ServerWatch,
    listening_endpoints,
    open_client,
    open_router,
    send_buffer_of,
)
from tests.waiting import DEADLINE_S


class Ticker:
    """Puts a counter every 10 ms until it is stopped."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._publisher = session.declare_publisher(key)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.01):
            self._publisher.put(b"tick")

    def close(self) -> None:
        self._stop.set()
        self._thread.join(5)


@pytest.fixture
def ticking(network):
    """A program that puts to a/b and starts before the router."""
    tickers = []
    network.connection().when_open(lambda session: tickers.append(Ticker(session, "a/b")))
    yield
    for ticker in tickers:
        ticker.close()


def test_a_client_delivers_after_the_router_opens_and_after_it_reopens(network, inbox, ticking):
    for _ in range(2):
        router, got = network.router_again(), inbox()
        router.declare_subscriber("a/b", got.put)
        assert got.until(len)
        router.close()


def test_the_router_relays_between_clients(network, inbox, ticking):
    """A camera's publications, replies and liveliness tokens reach a viewer, not only the server."""
    got, alive = inbox(), inbox()
    network.router_again()
    viewer, camera = network.client(), network.client()
    viewer.declare_subscriber("a/b", got.put)
    viewer.liveliness().declare_subscriber("a/alive", alive.put, history=True)
    token = camera.liveliness().declare_token("a/alive")
    queryable = camera.declare_queryable("a/q", lambda query: query.reply("a/q", b"answer"))
    assert got.until(len)
    assert alive.until(len)
    assert [reply.ok.payload.to_string() for reply in viewer.get("a/q", timeout=DEADLINE_S) if reply.ok] == [
        "answer"
    ]
    token.undeclare()
    assert alive.until(lambda samples: samples[-1].kind == zenoh.SampleKind.DELETE)
    queryable.undeclare()


def test_an_error_names_the_taken_port(network):
    network.router()
    with pytest.raises(NetworkError, match=network.endpoint.rsplit(":", 1)[1]) as caught:
        open_router([network.endpoint])
    assert "another server" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_port_0_is_replaced_by_the_port_that_clients_reach(inbox):
    """Of two endpoints with port 0; a client that connects to the second alone receives what is published."""
    listen = ["tcp/127.0.0.1:0"] * 2
    with open_router(listen) as router:
        endpoints = listening_endpoints(router, listen)
        assert len(set(endpoints)) == 2
        assert all(re.fullmatch(r"tcp/127\.0\.0\.1:[1-9]\d*", endpoint) for endpoint in endpoints)
        with open_client(endpoints[1:]) as client:
            received = inbox()
            router.declare_subscriber("a/b", received.put)
            ticker = Ticker(client, "a/b")
            assert received.until(len)
            ticker.close()


@pytest.mark.parametrize("endpoint", ["foo", "", "carrier-pigeon/roof:1"])
def test_an_error_names_the_invalid_endpoint(endpoint: str):
    for open_session in (open_client, open_router):
        with pytest.raises(NetworkError, match="tcp/"):
            open_session([endpoint]).close()


def test_a_zenoh_configuration_is_used_or_refused(tmp_path: Path, network):
    network.router()
    with pytest.raises(ConfigError, match=r"none\.json5 does not exist"):
        open_client([network.endpoint], tmp_path / "none.json5")
    broken = tmp_path / "broken.json5"
    for text in ("{", '{"nonsense": 1}'):
        broken.write_text(text)
        with pytest.raises(ConfigError, match=r"broken\.json5 .*Zenoh configuration"):
            open_client([network.endpoint], broken)
    good = tmp_path / "good.json5"
    good.write_text('{ id: "c0ffee" }')
    with open_client([network.endpoint], good) as session:
        assert str(session.zid()) == "c0ffee"


def test_publications_while_the_router_is_away_are_dropped(network, inbox, eventually):
    """10,000 publications of 4 kB are 40 MB; the first that arrives was sent later."""
    router = network.router()
    publisher = network.client().declare_publisher("a/b")
    router.close()
    for _ in range(10_000):
        publisher.put(bytes(4096))
    got = inbox()
    network.router_again().declare_subscriber("a/b", got.put)
    assert eventually(lambda: got.items, lambda: publisher.put(b"fresh"))
    assert got.items[0].payload.to_bytes() == b"fresh"


def test_the_servers_absence_and_return_are_logged_once_each(network, eventually, caplog):
    """However often the absence is checked; a server that was never present is absent as well."""
    caplog.set_level(logging.WARNING, "camera_node.protocol.session")
    router = network.router()
    watch = ServerWatch(network.client(), "a/alive", patience_s=0.0)

    def logged() -> list[str]:
        return [record.getMessage().split(";")[0] for record in caplog.records]

    for _ in range(3):
        watch.report_absence()
    assert logged() == ["the server is away"]
    token = router.liveliness().declare_token("a/alive")
    assert eventually(lambda: len(logged()) == 2)
    token.undeclare()
    assert eventually(lambda: len(logged()) == 3, watch.report_absence)
    watch.report_absence()
    assert logged() == ["the server is away", "the server is back", "the server is away"]
    watch.close()


@pytest.mark.parametrize(
    ("connect", "size"),
    [
        (("tcp/127.0.0.1:7447",), BURST_BUFFER),
        (("tls/localhost:7447", "tcp/[::1]:7447"), BURST_BUFFER),
        (("tcp/server:7447",), SEND_BUFFER),
        (("tcp/127.0.0.1:7447", "tcp/10.0.0.1:7447"), SEND_BUFFER),
        (("tcp/127.example.org:7447",), SEND_BUFFER),
    ],
)
def test_only_links_that_may_be_slow_have_a_small_send_buffer(connect: tuple[str, ...], size: int):
    """Before: on loopback, frames of 300 roundels and more were 25 to 45 ms late, and of 1000 roundels some dropped."""
    assert send_buffer_of(connect) == size


def test_a_giant_message_reaches_nobody_and_harms_no_other(network, inbox, eventually):
    """Before: a message of 200 MB was assembled by the router and by each subscriber, which did not return the memory.
    Zenoh closes its sender's connection, which opens again."""
    router, got = network.router(), inbox()
    router.declare_subscriber("a/**", lambda sample: got.put(len(sample.payload)))
    sender, other = network.client(), network.client()
    publisher = other.declare_publisher("a/other")
    sender.put("a/giant", bytes(MAX_MESSAGE + 1), congestion_control=zenoh.CongestionControl.BLOCK)
    assert eventually(lambda: publisher.put(b"tick") or len(got.items) > 20)
    assert set(got.items) == {4}
    assert eventually(lambda: sender.put("a/largest", bytes(MAX_BYTES)) or MAX_BYTES in got.items)
    assert set(got.items) == {4, MAX_BYTES}


def test_a_request_in_a_closed_session_is_a_network_error(network):
    """A thread of a program that ends may still ask."""
    network.router()
    client = network.client()
    client.close()
    with pytest.raises(NetworkError, match=r"test/robots.*closed"):
        send_request(client, "test/robots")
