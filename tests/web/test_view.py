# SPDX-License-Identifier: BSD-3-Clause
"""The page in a real browser, with messages over Zenoh."""

import errno
import os
import re
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from math import isclose
from typing import Any

import cv2
import numpy as np
import pytest
import viser
from playwright.sync_api import Page
from websockets.sync.client import connect

from calib.rig.camera import Camera
from calib.rig.rig import Rig
from camera_node.geometry.pose import Pose, look_at, rotation_from_wxyz
from camera_node.protocol.messages import encode
from tests.waiting import DEADLINE_S, repeating, wait_for
from tests.web.arena import LiveArena, four_cameras
from tests.web.browser import browsing, drawing, loopback
from web.errors import WebError
from web.scene.viewpoint import FIELD_OF_VIEW, MARGIN, USUAL_ROOM, default_viewpoint
from web.state.feed import ArenaState, DemoProgress, Feed, progress_key
from web.tabs.camera_tab import decode_jpeg
from web.view import PERIOD_S, View, check_port

HEIGHT_IN_PANEL = """() => {
    let y = document.activeElement.getBoundingClientRect().bottom;
    for (let box = document.activeElement.parentElement; box; box = box.parentElement) y += box.scrollTop;
    return Math.round(y);
}"""


@pytest.fixture
def page(view: View) -> Iterator[Page]:
    """The view's page in a browser."""
    with browsing(view) as page:
        yield page


def send_state(arena: LiveArena) -> None:
    """Send one message of each kind: four cameras, two robots, three markers."""
    for k, name in enumerate(four_cameras().cameras):
        arena.camera(
            name, advice="too dark" if k == 0 else "an advice that is too long for the width of the panel"
        )
        arena.detections(name, [(100.0 * k, 50.0)])
    arena.status(tuple(four_cameras().cameras))
    arena.pose("rover", (0.5, 0.0, 0.1))
    arena.pose("drone", (-0.5, 0.3, 0.8), "coasting")
    arena.markers([(0.5, 0.1, 0.1), (0.5, -0.1, 0.1), (0.4, 0.0, 0.1)])


@contextmanager
def sending(arena: LiveArena) -> Iterator[None]:
    """Send the state ten times a second."""
    with repeating(lambda: send_state(arena), 0.1):
        yield


def require_one_column(view: View, page: Page) -> None:
    """At 420 pixels the scene ends at the panel, has the height that a folded panel leaves, and is fitted to it."""
    page.set_viewport_size({"width": 420, "height": 850})
    page.get_by_role("tab", name="Cameras").wait_for()
    (client,) = view.server.get_clients().values()
    shape = "(c => c.clientWidth / c.clientHeight)([...document.querySelectorAll('canvas')].at(0))"
    for least_height in (0.44 * 850, 0.9 * 850):
        page.wait_for_function(
            f"Math.max(...[...document.querySelectorAll('canvas')].map(c => c.clientHeight)) >= {least_height}"
        )
        scene = (
            "Math.max(...[...document.querySelectorAll('canvas')].map(c => c.getBoundingClientRect().bottom))"
        )
        title = "[...document.querySelectorAll('div')].filter(d => d.innerText?.startsWith('Roundel: test')).at(-1)"
        page.wait_for_function(f"{scene} <= {title}.getBoundingClientRect().top")
        # The client reports the new shape of its scene some time after the browser has laid it out.
        wait_for(lambda: isclose(client.camera.aspect, page.evaluate(shape), rel_tol=0.02))
        wait_for(
            lambda: np.allclose(
                client.camera.position, default_viewpoint(four_cameras(), client.camera.aspect)[0], atol=0.05
            )
        )
        page.get_by_text("Roundel: test").first.click()  # folds the panel
    assert client.camera.aspect < 1


def focused_heights(page: Page, n: int) -> list[int]:
    """The heights in the panel of the `n` controls on which the key Tab stops after the first tab."""
    page.get_by_role("tab", name="Cameras").focus()
    heights = []
    for _ in range(n):
        page.keyboard.press("Tab")
        heights.append(page.evaluate(HEIGHT_IN_PANEL))
    return heights


def test_a_browser_shows_the_arena(arena: LiveArena, view: View, page: Page):
    """The panel shows all names, the image is not blank, and the buttons show the server's answers."""
    queryable = arena.serve_rig(four_cameras())
    token = arena.session.liveliness().declare_token(arena.keys.fusion_alive)
    jpeg = cv2.imencode(".jpg", np.full((48, 64), 90, np.uint8))[1].tobytes()
    key = arena.keys.snapshot("east")
    camera = arena.session.declare_queryable(key, lambda query: query.reply(key, jpeg))
    with sending(arena):
        page.get_by_text("camera east: an advice").wait_for()
        assert page.get_by_role("status").get_attribute("data-level") == "warn"
        for text in ("Roundel: test at tcp/127.0.0.1:1", "north", "30.0"):
            page.get_by_text(text).first.wait_for()
        for tab, text in (
            ("Status", "30 frame sets/s, latency 7.7 ms"),
            ("Robots", "coasting"),
            ("Robots", "rover"),
        ):
            page.get_by_role("tab", name=tab).click()
            page.get_by_text(text).first.wait_for()
    page.get_by_role("tab", name="Cameras").click()
    page.get_by_text("check its cable").first.wait_for()
    tables = "[...document.querySelectorAll('table')].map(t => t.offsetWidth - t.parentElement.clientWidth)"
    assert max(page.evaluate(tables)) <= 0, "a table is wider than the panel"
    page.wait_for_function("[...document.querySelectorAll('input')].some(input => input.value === 'east')")
    page.get_by_role("button", name="Take a snapshot").click()
    page.get_by_text("east, 64 x 48").wait_for()
    heights = focused_heights(page, 12)
    assert heights == sorted(heights), "the focus follows the order of reading"
    page.get_by_role("tab", name="Calibrate").click()
    assert page.get_by_role("button", name="Undo the last change").is_disabled(), "there is no earlier rig"
    page.get_by_role("button", name="Show the whole arena").click()
    picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100, "the page is not blank"
    require_one_column(view, page)
    assert not view.feed.state().faults
    for entity in (camera, queryable, token):
        entity.undeclare()


def test_drawing_follows_a_changing_arena(arena: LiveArena, feed: Feed):
    """Robots, markers and the rig appear and disappear without a fault."""
    view = View(feed, loopback())
    queryable = arena.serve_rig(four_cameras())
    token = arena.session.liveliness().declare_token(arena.keys.fusion_alive)
    for count in (3, 1, 5):
        send_state(arena)
        arena.markers([(float(k), 0.0, 0.0) for k in range(count)])
        arena.pose(f"robot_{count}", (0.0, 0.0, 0.0), "lost")
        wait_for(lambda count=count: f"robot_{count}" in feed.state().poses)
        view.update()
    wait_for(lambda: feed.state().rig, arena.status)
    view.update()
    arena.markers([])
    wait_for(lambda: (timed := feed.state().markers) and len(timed.message) == 0)
    view.update()
    assert not feed.state().faults
    view.close()
    queryable.undeclare()
    token.undeclare()


def test_discs_face_the_directions_of_their_prints(arena: LiveArena, feed: Feed):
    """One of three markers has no normal, and no disc. The batch grows from 16 to 40 discs, and empties."""
    view = View(feed, loopback())
    directions = [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.6, 0.0, -0.8)] * 10
    for n in (3, 40, 0):
        known = directions[:n]
        points = [(0.1 * k, 0.0, 0.0) for k in range(n + 1)]
        arena.markers(points, [*known, (np.nan, np.nan, np.nan)])
        wait_for(lambda n=n: (timed := feed.state().markers) and len(timed.message) == n + 1)
        view.update()
        assert view.discs.count == n
        shown = view.discs.batch.batched_scales > 0.5
        assert shown.sum() == n
        R = rotation_from_wxyz(view.discs.batch.batched_wxyzs[shown])
        np.testing.assert_allclose(R[:, :, 2], np.reshape(known, (-1, 3)), atol=1e-6)
        np.testing.assert_allclose(
            view.discs.batch.batched_positions[shown], points[:n] or np.empty((0, 3)), atol=1e-6
        )
    view.close()


def test_true_positions_appear_and_disappear(arena: LiveArena, feed: Feed):
    """The scene shows the simulated wand as long as the demo reports its position."""
    view = View(feed, loopback())
    for points in ({"wand": ((0.0, 0.0, 1.0), (0.2, 0.0, 1.0))}, {}):
        progress = DemoProgress(t_ns=0, text="*wand* <b>", share=0.5, true_points=points)
        arena.put(progress_key("test"), encode(progress))
        wait_for(lambda points=points: (p := feed.state().progress) and p.message.true_points == points)
        view.update()
        assert set(view.true_points.clouds) == set(points)
    view.close()


def test_a_drawing_that_fails_is_counted(feed: Feed, monkeypatch: pytest.MonkeyPatch):
    """The view continues after an exception, and counts it."""
    view = View(feed, loopback())

    def fail() -> None:
        raise ValueError("odd")

    monkeypatch.setattr(view, "update", fail)
    with drawing(view):
        wait_for(lambda: feed.state().faults["drawing: ValueError('odd')"] >= 2)


def test_a_port_in_use_is_an_error():
    """Viser itself would silently use the next one."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(WebError, match=rf"127.0.0.1:{port} \({os.strerror(errno.EADDRINUSE)}\).*--port"):
            check_port("127.0.0.1", port)
    with pytest.raises(WebError, match=r"70000.*--port"):
        check_port("127.0.0.1", 70_000)


@pytest.mark.parametrize("aspect", [2.0, 1.0, 0.5])
@pytest.mark.parametrize("rig", [four_cameras(), None])
def test_the_default_viewpoint_shows_the_whole_rig(rig: Rig | None, aspect: float):
    """Pictures of any shape show all cameras and the floor below them; the outermost point is at the margin."""
    position, target = (np.array(point) for point in default_viewpoint(rig, aspect))
    assert position[2] > target[2] > 0
    focal = 1 / np.tan(FIELD_OF_VIEW / 2)
    eye = Camera(
        width=1,
        height=1,
        fx=focal,
        fy=focal,
        cx=0,
        cy=0,
        T_world_cam=Pose.from_matrix(look_at(position, target)),
    )
    centres = np.array(
        [camera.matrix()[:3, 3] for camera in (rig.placed() if rig else {}).values()] or USUAL_ROOM
    )
    seen = np.abs(eye.project_world(np.vstack([centres, centres * [1, 1, 0]]))) / (aspect, 1)
    np.testing.assert_allclose(seen.max(), MARGIN, atol=0.02)


@pytest.mark.parametrize("data", [b"", b"not an image", bytes(100)])
def test_bytes_that_are_not_a_jpeg(data: bytes):
    assert decode_jpeg(data) is None


class SlowSection:
    """Counts the drawings in a text of the page; each takes three times as long as it may."""

    def __init__(self, view: View) -> None:
        self.count = 0
        self._text = view.server.gui.add_markdown("")

    def update(self, state: ArenaState) -> None:
        self.count += 1
        self._text.content = f"drawing {self.count}."
        begun = time.monotonic()
        while time.monotonic() - begun < 3 * PERIOD_S:
            pass


def test_browsers_follow_where_drawings_take_longer_than_their_period():
    """As on a loaded machine: with drawings that followed each other at once, browsers received one in twenty."""
    view = View(Feed("test"), loopback())
    section = SlowSection(view)
    view.add(section, interval=1)
    protocol: Any = [f"viser-v{viser.__version__}"]
    received: set[bytes] = set()
    with (
        drawing(view),
        connect(f"ws://127.0.0.1:{view.access.port}", subprotocols=protocol, max_size=None) as browser,
    ):
        while section.count < 12:
            received |= set(re.findall(rb"drawing \d+\.", bytes(browser.recv(DEADLINE_S, decode=False))))
    assert len(received) > section.count / 2
