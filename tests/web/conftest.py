# SPDX-License-Identifier: BSD-3-Clause
"""Fixtures: an arena on a real Zenoh router on loopback, and a feed that is connected to it."""

from collections.abc import Iterator

import pytest

from camera_node.protocol.session import open_client
from tests.waiting import wait_for
from tests.web.arena import LiveArena
from web.feed import Feed
from web.subscription import Subscription


@pytest.fixture
def arena() -> Iterator[LiveArena]:
    arena = LiveArena()
    yield arena
    arena.session.close()


@pytest.fixture
def subscription(arena: LiveArena) -> Iterator[Subscription]:
    """A connected feed: it receives every later message."""
    session = open_client([arena.endpoint])
    subscription = Subscription(session, Feed("test"))
    wait_for(lambda: subscription.feed.state().markers, lambda: arena.markers([(0, 0, 0)]))
    yield subscription
    subscription.close()
    session.close()


@pytest.fixture
def feed(subscription: Subscription) -> Feed:
    """The connected feed."""
    return subscription.feed
