# SPDX-License-Identifier: BSD-3-Clause
"""Fixtures: an arena on a real Zenoh router on loopback, and a feed that is connected to it."""

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from camera_node.protocol.server_connection import ServerConnection
from tests.conftest import is_of_page
from tests.waiting import wait_for
from tests.web.arena import LiveArena
from tests.web.browser import drawing, end_chromium, loopback
from web.page import add_live_page
from web.state.feed import Feed
from web.state.subscription import Subscription
from web.view import View


def pytest_runtest_teardown(nextitem: pytest.Item | None) -> None:
    """End the browser that the first test of the page started after the last one."""
    if nextitem is None or not is_of_page(nextitem):
        end_chromium()


@pytest.fixture
def arena() -> Iterator[LiveArena]:
    arena = LiveArena()
    yield arena
    arena.session.close()


@pytest.fixture
def subscription(arena: LiveArena) -> Iterator[Subscription]:
    """A connected feed: it receives every later message."""
    connection = ServerConnection([arena.endpoint])
    subscription = Subscription(connection, Feed("test"))
    wait_for(lambda: subscription.feed.state().markers, lambda: arena.markers([(0, 0, 0)]))
    yield subscription
    subscription.close()
    connection.close()


@pytest.fixture
def feed(subscription: Subscription) -> Feed:
    """The connected feed."""
    return subscription.feed


@pytest.fixture
def view(subscription: Subscription) -> Iterator[View]:
    """A view of the arena that draws."""
    view = View(subscription.feed, loopback())
    with ExitStack() as closing, drawing(view):
        add_live_page(view, subscription, "tcp/127.0.0.1:1", None, closing)
        yield view
