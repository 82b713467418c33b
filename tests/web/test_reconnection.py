# SPDX-License-Identifier: BSD-3-Clause
"""An open page follows a restarted server without being loaded again."""

from contextlib import ExitStack
from pathlib import Path

import msgspec
import pytest

from camera_node.protocol.server_connection import ServerConnection
from fusion.model.robots import turn_heading
from tests.conftest import free_port
from tests.fusion.serving import config, serving
from tests.fusion.synthetic import TRIANGLE
from tests.waiting import wait_for
from tests.web.browser import browsing, drawing, loopback
from web.page import add_live_page
from web.state.feed import Feed
from web.state.subscription import Subscription
from web.view import View


@pytest.mark.slow  # the page waits for some seconds before it calls a server silent
def test_a_page_follows_the_next_server_without_a_reload(tmp_path: Path):
    """It says that the first one is silent; a change that is made afterwards reaches the second one."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    settings = msgspec.structs.replace(config(tmp_path), listen=(endpoint,))
    with ServerConnection([endpoint]) as connection, ExitStack() as closing:
        subscription = Subscription(connection, Feed("test"))
        closing.callback(subscription.close)
        view = View(subscription.feed, loopback())
        closing.enter_context(drawing(view))
        add_live_page(view, subscription, endpoint, None, closing, tmp_path)
        with browsing(view) as page:
            page.get_by_role("tab", name="Robots").click()
            page.get_by_text("One robot").click()
            with serving(settings):
                page.get_by_role("cell", name="\u25cf a").wait_for()
            page.get_by_text("the server is silent for").first.wait_for()
            with serving(settings) as (_, client):
                page.get_by_text("the server is silent for").first.wait_for(state="detached")
                wait_for(lambda: view.feed.state().declared)
                page.get_by_role("button", name="Turn the heading").click()
                page.get_by_text("turned by 90 degrees").first.wait_for()
                assert client.declared_robots().robots == {"a": turn_heading(TRIANGLE, 90.0)}
