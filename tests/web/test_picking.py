# SPDX-License-Identifier: BSD-3-Clause
"""A robot is defined by clicks on its markers, in a real browser, of a real server."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, TimeoutError

from camera_node.protocol.session import open_client
from fusion.client.arena import Arena as Client
from tests.conftest import free_port
from tests.fusion.serving import DEADLINE_S, WIDE_MOTION, serving_an_unknown_robot, until
from tests.fusion.synthetic import WIDE
from tests.web.conftest import wait_for
from tests.web.test_view import browsing, drawing
from web.feed import Feed
from web.picking import Picking
from web.subscription import Subscription
from web.view import View


@pytest.fixture
def arena(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Client, View, Picking]]:
    """A page on a running arena in which a robot stands that nobody declared.

    Drawn five times a second: the browser, without a graphics card, is to have time for clicks.
    """
    monkeypatch.setattr("web.view.PERIOD_S", 0.2)
    monkeypatch.setattr("web.view.PANEL_EVERY", 2)
    with serving_an_unknown_robot(tmp_path) as (endpoint, client), open_client([endpoint]) as session:
        subscription = Subscription(session, Feed("test"))
        view = View(subscription.feed, port=free_port())
        picking = Picking(view.server, subscription)
        view.add(picking)
        with drawing(view):
            yield client, view, picking
        subscription.close()


def places() -> np.ndarray:
    """(3, 3) where its markers are, world."""
    R, p = WIDE_MOTION(0.0)
    return p + WIDE.points @ R.T


def pixel(view: View, page: Page, point: np.ndarray) -> tuple[float, float]:
    """Where the page shows a point of the world: the browser's camera looks along its z, y down."""
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


def click(act: Callable[[], None], page: Page, answer: str) -> None:
    """Click as a person does: once more where nothing comes of it, as a marker may be unseen for an instant."""
    for _ in range(3):
        act()
        with contextlib.suppress(TimeoutError):
            return page.get_by_text(answer).wait_for(timeout=20_000)
    raise AssertionError(f"three clicks, and not '{answer}'")


def test_a_robot_is_defined_by_clicks(arena: tuple[Client, View, Picking]):
    """Picked in the scene, named in the panel; the server then tracks it, with x towards the marker picked first."""
    client, view, picking = arena
    with browsing(view) as page:
        page.set_default_timeout(1e3 * DEADLINE_S)
        page.get_by_role("button", name="Pick its markers").click()
        page.get_by_text("the grey ones").wait_for()
        page.get_by_text("cam0").first.wait_for()  # the rig is drawn, and the view framed
        for k, place in enumerate(places()):
            click(lambda place=place: page.mouse.click(*pixel(view, page, place)), page, f"{k + 1} picked")
        assert np.linalg.norm(np.array(picking.picked) - places(), axis=1).max() < 0.01
        inputs = "[...document.querySelectorAll('input')].find(input => input.value === 'robot')"
        name = page.evaluate_handle(inputs).as_element()
        assert name is not None
        name.fill("wide")
        wait_for(lambda: picking._name.value == "wide")
        define = page.get_by_role("button", name="Define it")
        click(define.click, page, "the server now tracks wide, with 3 markers")
    until(lambda: client.robot("wide", DEADLINE_S).next().state == "tracked")
    robot = client.change_robots()["wide"]
    assert robot.diameter_m == 0.12
    first = WIDE.points[0] - WIDE.points.mean(0)
    assert abs(robot.points[0, 0] - np.linalg.norm(first)) < 2e-3
    assert picking.picked == []


def test_what_can_not_be_defined_is_said(arena: tuple[Client, View, Picking]):
    """No marker picked; a marker given back; one that is not there; a name that is none; two on one line."""
    _, _, picking = arena
    assert picking.define() == "no marker is picked"
    picking._toggle()
    above = places()[0] + [0.0, 0.0, 2.0]
    wait_for(lambda: picking.pick(above, (0.0, 0.0, -1.0)) or picking.picked)
    picking.pick(above, (0.0, 0.0, -1.0))
    assert picking.picked == []
    picking.pick(above, (1.0, 0.0, 0.0))
    assert picking.picked == [], "nothing lies there"
    picking.picked = [np.array([0.9, 0.9, 0.1])]
    assert "at 0.90, 0.90, 0.10 m does not stand still" in picking.define()
    picking.picked = list(places()[:2])
    assert "make no robot" in picking.define()
    picking._name.value = "a/b"
    assert "can't name a robot" in picking.define()


def test_nothing_is_picked_unless_asked_for(arena: tuple[Client, View, Picking]):
    _, _, picking = arena
    wait_for(lambda: len(picking._free))
    picking.pick(places()[0] + [0.0, 0.0, 2.0], (0.0, 0.0, -1.0))
    assert picking.picked == []
