# SPDX-License-Identifier: BSD-3-Clause
"""A robot is defined by clicks on its markers, with a real browser and a real server."""

import re
from collections.abc import Iterator

import numpy as np
import pytest
import viser
from playwright.sync_api import Page

from camera_node.foundation.errors import RoundelError
from camera_node.protocol.server_connection import ServerConnection
from fusion.client.arena import Arena as Client
from tests.fusion.synthetic import WIDE
from tests.fusion.unknown_robot import WIDE_MOTION, serving_an_unknown_robot
from tests.waiting import DEADLINE_S, Inbox, wait_for
from tests.web.browser import browsing, showing, value_of
from web.scene.viewpoint import SAME_M, default_viewpoint
from web.state.feed import Feed
from web.state.subscription import Subscription
from web.tabs.camera_tab import CameraTable
from web.tabs.marker_picker import MarkerPicker
from web.view import View


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Client]]:
    """A running arena with an undeclared robot, which only the last test declares."""
    with serving_an_unknown_robot(tmp_path_factory.mktemp("arena")) as (endpoint, client):
        yield endpoint, client


@pytest.fixture
def arena(served: tuple[str, Client]) -> Iterator[tuple[Client, View, MarkerPicker]]:
    """Its page."""
    endpoint, client = served
    with ServerConnection([endpoint]) as connection:
        subscription = Subscription(connection, Feed("test"))
        make = lambda view: MarkerPicker(view.server, subscription)  # noqa: E731
        with showing(subscription.feed, make) as (view, picker):
            view.add(CameraTable(view.server.gui))
            yield client, view, picker
        subscription.close()


def marker_positions() -> np.ndarray:
    """(3, 3) positions of the robot's markers, world."""
    R, p = WIDE_MOTION(0.0)
    return p + WIDE.points @ R.T


def pixel(view: View, page: Page, point: np.ndarray) -> tuple[float, float]:
    """Project a point of the world to the page; the camera of the browser has z forward and y down."""
    (client,) = view.server.get_clients().values()
    box = page.locator("canvas").first.bounding_box()
    assert box is not None
    ahead = np.subtract(client.camera.look_at, client.camera.position)
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, client.camera.up_direction)
    right = right / np.linalg.norm(right)
    to = point - client.camera.position
    x, y = np.array([to @ right, to @ np.cross(ahead, right)]) / (to @ ahead)
    focal = box["height"] / 2 / np.tan(client.camera.fov / 2)
    return box["x"] + box["width"] / 2 + focal * x, box["y"] + box["height"] / 2 + focal * y


def reported_positions(view: View) -> list[np.ndarray]:
    """A list to which later browsers add the positions of their cameras."""
    positions: list[np.ndarray] = []

    @view.server.on_client_connect
    def _(client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda camera: positions.append(np.array(camera.position)))

    return positions


def shows_all_of_the_rig(view: View, positions: list[np.ndarray]) -> bool:
    """Whether the browser has reported the viewpoint that the page gave it last."""
    (client,) = view.server.get_clients().values()
    chosen, _ = default_viewpoint(view._rig, client.camera.aspect)
    return bool(view._rig and positions and np.linalg.norm(positions[-1] - chosen) < SAME_M)


def handled_clicks(picker: MarkerPicker) -> Inbox:
    """Collects the clicks in the scene once the picker has handled them."""
    handled, select = Inbox(), picker.select
    picker.select = lambda origin, direction: handled.put(select(origin, direction))
    return handled


def selects(point: np.ndarray, arena: tuple[Client, View, MarkerPicker], page: Page, handled: Inbox) -> bool:
    """Click on a marker; return whether it is selected, once the click is handled.

    The server may be too slow to publish the marker for a while, and a second click before the first was handled would
    deselect it.
    """
    _, view, picker = arena
    n, before = len(picker.selected), len(handled.items)
    page.mouse.click(*pixel(view, page, point))
    assert handled.until(lambda items: len(items) > before)
    return len(picker.selected) > n


def test_an_invalid_definition_is_refused(arena: tuple[Client, View, MarkerPicker]):
    """No marker selected, which clicks do only after the button; a marker deselected; one that is not there; another
    diameter; two markers; a bad name."""
    _, _, picker = arena
    refused(picker, "no marker")
    wait_for(lambda: len(picker._unlabeled))
    above = marker_positions()[0] + [0.0, 0.0, 2.0]
    picker.select(above, (0.0, 0.0, -1.0))
    assert picker.selected == []
    picker._toggle()
    wait_for(lambda: picker.selected, lambda: picker.select(above, (0.0, 0.0, -1.0)))
    picker.select(above, (0.0, 0.0, -1.0))
    assert picker.selected == []
    picker.select(above, (1.0, 0.0, 0.0))
    assert picker.selected == [], "there is no marker in this direction"
    picker.selected = [np.array([0.9, 0.9, 0.1])]
    refused(picker, "0.90, 0.90, 0.10 m")
    picker.selected = list(marker_positions())
    refused(picker, "measure about 120 mm, not 90 mm")
    picker._diameter.here.value = 120.0
    picker.selected = list(marker_positions()[:2])
    refused(picker, "make no robot")
    picker._name.here.value = "a/b"
    refused(picker, "'a/b'")


def test_a_robot_is_defined_by_clicks(arena: tuple[Client, View, MarkerPicker]):
    """Select its markers, enter its name; then the server tracks it, with x towards the first selected marker."""
    client, view, picker = arena
    positions, clicks = reported_positions(view), handled_clicks(picker)
    with browsing(view) as page:
        page.get_by_role("button", name="Select markers").click()
        page.get_by_text("click the robot's grey markers").wait_for()
        wait_for(lambda: shows_all_of_the_rig(view, positions))
        for k, point in enumerate(marker_positions()):
            wait_for(lambda point=point: selects(point, arena, page, clicks))
            page.get_by_text(f"{k + 1} selected").wait_for()
        assert np.linalg.norm(np.array(picker.selected) - marker_positions(), axis=1).max() < 0.01
        inputs = "[...document.querySelectorAll('input')].find(input => input.value === 'robot')"
        name = page.evaluate_handle(inputs).as_element()
        assert name is not None
        name.fill("wide")
        page.get_by_text("Black disc, mm").locator("xpath=ancestor::*[.//input][1]").locator("input").fill(
            "120"
        )
        wait_for(lambda: (value_of(view, "Name"), value_of(view, "Black disc, mm")) == ("wide", 120.0))
        page.get_by_role("button", name="Define robot").click()
        page.get_by_text(re.compile("wide.* 3 markers")).wait_for()
        wait_for(lambda: client.robot("wide", DEADLINE_S).next().state == "tracked")
        robot = client.change_robots()["wide"]
        client.change_robots(remove=["wide"])
        name.fill("all")
        wait_for(lambda: value_of(view, "Name") == "all")
        page.get_by_role("button", name="Define from everything stationary").click()
        page.get_by_text(re.compile("all.* 3 markers")).wait_for()
    assert robot.diameter_m == 0.12
    first = WIDE.points[0] - WIDE.points.mean(0)
    assert abs(robot.points[0, 0] - np.linalg.norm(first)) < 2e-3
    assert picker.selected == []


def refused(picker: MarkerPicker, reason: str) -> None:
    with pytest.raises(RoundelError, match=reason):
        picker.define()
