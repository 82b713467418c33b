# SPDX-License-Identifier: BSD-3-Clause
"""The tab Robots in a real browser with a real server: rename, turn, save and delete a robot by clicks."""

import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from playwright.sync_api import Page

from camera_node.protocol.server_connection import ServerConnection
from fusion.client.arena import Arena as Client
from fusion.model.robots import load_robots, turn_heading
from tests.fusion.serving import config, serving
from tests.fusion.synthetic import TRIANGLE
from tests.waiting import wait_for
from tests.web.browser import browsing, drawing, loopback
from web.page import add_live_page
from web.state.feed import Feed
from web.state.subscription import Subscription
from web.view import View


@pytest.fixture
def arena(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Client, View]]:
    """A running server that declares the robot a, and its page."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "server").mkdir()
    with (
        serving(config(tmp_path / "server")) as (server, client),
        ServerConnection(server.endpoints) as connection,
    ):
        subscription = Subscription(connection, Feed("test"))
        view = View(subscription.feed, loopback())
        with ExitStack() as closing, drawing(view):
            add_live_page(view, subscription, server.endpoints[0], None, closing)
            yield client, view
        subscription.close()


def open_editor(page: Page) -> None:
    page.get_by_role("tab", name="Robots").click()
    page.get_by_text("One robot").click()
    choose(page, "a")


def choose(page: Page, robot: str) -> None:
    """Wait until the list of robots offers a robot, as its only one."""
    page.wait_for_function(
        f"[...document.querySelectorAll('input')].some(input => input.value === '{robot}')"
    )


def test_a_robot_is_changed_by_clicks(arena: tuple[Client, View], tmp_path: Path):
    client, view = arena
    with browsing(view) as page:
        open_editor(page)
        wait_for(lambda: view.feed.state().declared == {"a": TRIANGLE})  # requested from the server
        page.get_by_role("button", name="Turn the heading").click()
        page.get_by_text("turned by 90 degrees").first.wait_for()
        assert (
            client.declared_robots().robots
            == view.feed.state().declared
            == {"a": turn_heading(TRIANGLE, 90.0)}
        )
        page.get_by_role("button", name="Move the pivot").click()
        page.get_by_text("the origin of a moved by 0, 0, 0 m").first.wait_for()
        page.get_by_text("New name").locator("xpath=ancestor::*[.//input][1]").locator("input:visible").fill(
            "cart"
        )
        page.get_by_role("button", name="Rename").click()
        page.get_by_text("a is cart now").first.wait_for()
        choose(page, "cart")  # the field of the new name is empty again
        page.get_by_role("button", name="Save all robots").click()
        page.get_by_text("wrote 1 robots").wait_for()
        assert load_robots(tmp_path / "robots.yaml") == {"cart": turn_heading(TRIANGLE, 90.0)}
        page.get_by_role("button", name="Delete", exact=True).click()
        page.get_by_role("button", name="Delete: click again").click()
        page.get_by_text("cart is deleted").first.wait_for()
        wait_for(lambda: client.declared_robots().robots == {})


@pytest.mark.ci
def test_changes_are_undone_where_they_were_made(arena: tuple[Client, View]):
    """The latest first; a robot that another program changed since is left as it is."""
    client, view = arena
    with browsing(view) as page:
        open_editor(page)
        undo = page.get_by_role("button", name="Undo the change of a robot")
        page.get_by_role("button", name="Turn the heading").click()
        page.get_by_text("turned by 90 degrees").first.wait_for()
        page.get_by_role("button", name="Delete", exact=True).click()
        page.get_by_role("button", name="Delete: click again").click()
        page.get_by_text("a is deleted").first.wait_for()
        undo.click()
        page.get_by_text("undone: a is deleted").first.wait_for()
        assert client.declared_robots().robots == {"a": turn_heading(TRIANGLE, 90.0)}
        undo.click()
        page.get_by_text("undone: the x axis of a turned").first.wait_for()
        assert client.declared_robots().robots == {"a": TRIANGLE}
        page.get_by_role("button", name="Turn the heading").click()
        page.get_by_text(re.compile("^the x axis of a turned by 90 degrees")).first.wait_for()
        client.change_robots(define={"a": TRIANGLE}, replace=True)
        undo.click()
        page.get_by_text("a changed since, by another program or page: nothing is undone").wait_for()
        assert client.declared_robots().robots == {"a": TRIANGLE}
