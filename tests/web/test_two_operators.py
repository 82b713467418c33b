# SPDX-License-Identifier: BSD-3-Clause
"""Two browsers on the page of a real server: each sees what the other one changes, and keeps what it types."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import msgspec
import pytest
from playwright.sync_api import Locator, Page

from camera_node.protocol.server_connection import ServerConnection
from fusion.client.arena import Arena as Client
from fusion.model.robots import turn_heading
from tests.fusion.serving import config, serving
from tests.fusion.synthetic import TRIANGLE, WIDE
from tests.waiting import wait_for
from tests.web.browser import browsing, drawing, loopback, set_checkbox
from web.page import TABS, add_live_page
from web.state.feed import Feed
from web.state.subscription import Subscription
from web.view import View

MAX_CONTROLS = 60  # of the page, more than it has


@pytest.fixture
def arena(tmp_path: Path) -> Iterator[tuple[Client, View]]:
    """A running server that declares the robots a and b, and its page."""
    with serving(config(tmp_path)) as (server, client), ServerConnection(server.endpoints) as connection:
        client.change_robots(define={"b": msgspec.structs.replace(WIDE, start_m=None)})
        subscription = Subscription(connection, Feed("test"))
        view = View(subscription.feed, loopback())
        with ExitStack() as closing, drawing(view):
            add_live_page(view, subscription, server.endpoints[0], None, closing, tmp_path)
            wait_for(lambda: set(view.feed.state().declared) == {"a", "b"})
            yield client, view
        subscription.close()


def field(page: Page, label: str) -> Locator:
    return page.locator(f"xpath=//*[text()='{label}']/following::input[1]").locator("visible=true")


def choose(page: Page, label: str, option: str) -> None:
    field(page, label).click()
    page.get_by_role("option", name=option, exact=True).click()


@pytest.mark.ci
def test_each_operator_sees_the_other_s_changes_and_keeps_its_own_text(arena: tuple[Client, View]):
    client, view = arena
    with browsing(view) as one:
        browser = one.context.browser
        assert browser is not None
        other = browser.new_page()
        other.goto(view.access.address)
        for page in (one, other):
            page.get_by_role("tab", name="Robots").click()
            page.get_by_text("One robot").click()
        choose(other, "Robot", "b")
        field(other, "New name").fill("truck")
        assert field(one, "New name").input_value() == ""
        assert field(one, "Robot").input_value() == "a"
        field(one, "New name").fill("cart")
        one.get_by_role("button", name="Rename", exact=True).click()
        for page in (one, other):
            page.get_by_text("a is cart now").first.wait_for()
        wait_for(lambda: [field(one, label).input_value() for label in ("Robot", "New name")] == ["cart", ""])
        assert [field(other, label).input_value() for label in ("Robot", "New name")] == ["b", "truck"]
        one.get_by_role("button", name="Undo the change of a robot: a is cart now").first.wait_for()
        other.get_by_role("button", name="Undo the change of a robot: a is cart now").click()
        one.get_by_text("undone: a is cart now").first.wait_for()
        choose(one, "Robot", "b")
        one.get_by_role("button", name="Delete", exact=True).click()
        one.get_by_role("button", name="Delete: click again").click()
        one.get_by_text("b is deleted").first.wait_for()
        wait_for(lambda: field(other, "Robot").input_value() == "choose one")  # and not another robot
        other.get_by_role("button", name="Rename", exact=True).click()
        other.get_by_text("was renamed or removed meanwhile: choose one").wait_for()
        assert field(other, "New name").input_value() == "truck"
        assert set(client.declared_robots().robots) == {"a"}


def test_the_keyboard_alone_turns_a_robot(arena: tuple[Client, View]):
    """From tab to tab with arrows, Tab to a folder, which Enter opens and Space closes, and on to its buttons."""
    client, view = arena
    with browsing(view) as page:
        page.get_by_role("tab", name="Cameras").focus()
        for _ in TABS[: TABS.index("Robots")]:
            page.keyboard.press("ArrowRight")
        page.keyboard.press("Enter")
        folder = page.get_by_role("button", name="One robot", exact=True)
        folder.wait_for()
        press_tab_until(page, folder)
        page.keyboard.press("Enter")
        turn = page.get_by_role("button", name="Turn the heading")
        turn.wait_for()
        assert folder.get_attribute("aria-expanded") == "true"
        page.keyboard.press("Space")
        turn.wait_for(state="hidden")
        page.keyboard.press("Space")
        turn.wait_for()
        press_tab_until(page, turn)
        page.keyboard.press("Enter")
        page.get_by_text("turned by 90 degrees").first.wait_for()
        assert client.declared_robots().robots["a"] == turn_heading(TRIANGLE, 90.0)


def press_tab_until(page: Page, control: Locator) -> None:
    """Press Tab until a control has the focus."""
    for _ in range(MAX_CONTROLS):
        page.keyboard.press("Tab")
        if control.evaluate("control => control === document.activeElement"):
            return
    raise AssertionError(f"Tab does not reach {control}")


def test_robots_are_selected_together_and_keys_act(arena: tuple[Client, View]):
    """By both browsers; the others are hidden, the selected ones deleted, and all of them come back at once."""
    client, view = arena
    with browsing(view) as page:
        page.get_by_text("? shows the keys").wait_for()
        page.keyboard.press("Shift+?")
        page.get_by_text("Undo the change of a robot").first.wait_for()
        page.get_by_role("button", name="Close").click()
        page.get_by_role("tab", name="Robots").click()
        page.get_by_text("Several robots").click()
        page.get_by_role("button", name="a", exact=True).click()
        page.get_by_text("selected: a", exact=True).wait_for()
        set_checkbox(page, view, "Show only the selected robots")
        assert (view.robots.is_shown("a"), view.robots.is_shown("b")) == (True, False)
        page.get_by_role("button", name="Select all or none").click()
        page.get_by_text("selected: none").wait_for()
        page.get_by_role("button", name="Select all or none").click()
        page.get_by_text("selected: a, b").wait_for()
        page.get_by_role("button", name="Delete the selected robots").click()
        page.get_by_text("click again to delete a, b").wait_for()
        page.get_by_role("button", name="Delete: click again").click()
        page.get_by_text("a, b are deleted").first.wait_for()
        assert client.declared_robots().robots == {}
        page.get_by_role("button", name="Undo the change of a robot: a, b are deleted").first.wait_for()
        page.keyboard.press("u")
        page.get_by_text("undone: a, b are deleted").first.wait_for()
        assert client.declared_robots().robots.keys() == {"a", "b"}
        assert client.declared_robots().robots["a"] == TRIANGLE
