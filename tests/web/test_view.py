# SPDX-License-Identifier: BSD-3-Clause
"""The page in a real browser, fed by real messages."""

import re
import shutil
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np
import pytest
from playwright.sync_api import ConsoleMessage, Page, sync_playwright

from tests.conftest import free_port
from tests.web.conftest import Played, four_cameras, wait_for
from web.controls import LiveControls, decode_jpeg
from web.drawing import puck
from web.errors import WebError
from web.feed import Feed
from web.messages import DemoProgress, progress_key
from web.subscription import Subscription
from web.view import View, check_port, frame

CHROMIUM = shutil.which("chromium")
FLAGS = [
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    "--disable-background-networking",
    "--disable-sync",
    "--disable-component-update",
    "--no-first-run",
]


@pytest.fixture
def view(subscription: Subscription) -> Iterator[View]:
    """A view that draws."""
    view = View(subscription.feed, port=free_port())
    view.add(LiveControls(view.server, subscription))
    with drawing(view):
        yield view


@contextmanager
def drawing(view: View) -> Iterator[None]:
    """A view draws, and is closed at the end."""
    stop = threading.Event()
    thread = threading.Thread(target=view.run, args=(stop,))
    thread.start()
    yield
    stop.set()
    thread.join()
    view.close()


@contextmanager
def browsing(view: View) -> Iterator[Page]:
    """A browser on the view; an error on its console fails the test."""
    if CHROMIUM is None:
        pytest.skip("no chromium on this machine; apt-get install chromium")
    errors: list[str] = []

    def hear(message: ConsoleMessage) -> None:
        if message.type == "error":
            errors.append(message.text)

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": 1000, "height": 700})
        page.on("console", hear)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(view.url)
        yield page
        browser.close()
    assert not errors


@pytest.fixture
def page(view: View) -> Iterator[Page]:
    """A browser on the view."""
    with browsing(view) as page:
        yield page


def play(played: Played) -> None:
    """One moment of an arena: four cameras, two robots, three markers."""
    for k, name in enumerate(four_cameras().cameras):
        played.camera(name, advice="too dark" if k == 0 else "moved: excluded until it is recalibrated")
        played.detections(name, [(100.0 * k, 50.0)])
    played.status(tuple(four_cameras().cameras))
    played.pose("rover", (0.5, 0.0, 0.1))
    played.pose("drone", (-0.5, 0.3, 0.8), "coasting")
    played.markers([(0.5, 0.1, 0.1), (0.5, -0.1, 0.1), (float("nan"), 0.0, 0.0)])


@contextmanager
def playing(played: Played) -> Iterator[None]:
    """The arena goes on, ten moments a second."""
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(0.1):
            play(played)

    thread = threading.Thread(target=run)
    thread.start()
    yield
    stop.set()
    thread.join()


def test_a_browser_shows_the_arena(played: Played, view: View, page: Page):
    """Names stand in the scene and in the panel, the picture is not blank, buttons reach the server and answer."""
    queryable = played.serve_rig(four_cameras())
    token = played.session.liveliness().declare_token(played.keys.fusion_alive)
    jpeg = cv2.imencode(".jpg", np.full((48, 64), 90, np.uint8))[1].tobytes()
    key = played.keys.snapshot("east")
    camera = played.session.declare_queryable(key, lambda query: query.reply(key, jpeg))
    with playing(played):
        for text in ("rover", "coasting", "north", "30 poses/s", "latency ms: camera 3.0, network 0.2"):
            page.get_by_text(text).first.wait_for(timeout=20_000)
    page.get_by_text("too dark").first.wait_for(timeout=20_000)
    tables = "[...document.querySelectorAll('table')].map(t => t.offsetWidth - t.parentElement.clientWidth)"
    assert max(page.evaluate(tables)) <= 0, "a table is wider than the panel"
    page.wait_for_function("[...document.querySelectorAll('input')].some(input => input.value === 'east')")
    for _ in range(4):  # a busy machine may take longer than the two seconds after which the view gives up
        page.get_by_role("button", name="Take its picture").click()
        answer = page.get_by_text(re.compile("east, 64 x 48|sent no picture"))
        answer.wait_for(timeout=20_000)
        if "64 x 48" in answer.inner_text():
            break
    page.get_by_text("east, 64 x 48").wait_for(timeout=20_000)
    page.get_by_role("button", name="Undo the last correction").click()
    page.get_by_text("no server of arena").wait_for(timeout=20_000)
    page.get_by_role("button", name="Frame the arena").click()
    picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100, "a picture, not one colour"
    assert not view.feed.latest().faults
    for entity in (camera, queryable, token):
        entity.undeclare()


def test_drawing_survives_what_an_arena_may_say(played: Played, feed: Feed):
    """Robots come and fall silent, markers vanish, a rig comes and goes; nothing is counted as a fault."""
    view = View(feed, port=free_port())
    queryable = played.serve_rig(four_cameras())
    token = played.session.liveliness().declare_token(played.keys.fusion_alive)
    for count in (3, 1, 5):
        play(played)
        played.markers([(float(k), 0.0, 0.0) for k in range(count)])
        played.pose(f"robot {count}", (0.0, 0.0, 0.0), "lost")
        wait_for(lambda count=count: f"robot {count}" in feed.latest().poses)
        view.update()
    wait_for(lambda: played.status() or feed.latest().rig)
    view.update()
    played.markers([])
    wait_for(lambda: (seen := feed.latest().markers) and len(seen.message) == 0)
    view.update()
    assert not feed.latest().faults
    view.close()
    queryable.undeclare()
    token.undeclare()


def test_progress_and_ghosts_come_and_go(played: Played, feed: Feed):
    """The demo's wand stands in the scene as long as it is told."""
    from camera_node.protocol.messages import encode

    view = View(feed, port=free_port())
    for ghosts in ({"wand": ((0.0, 0.0, 1.0), (0.2, 0.0, 1.0))}, {}):
        progress = DemoProgress(t_ns=0, text="*waving* <b>", share=0.5, ghosts=ghosts)
        played.put(progress_key("test"), encode(progress))
        wait_for(lambda ghosts=ghosts: (p := feed.latest().progress) and p.message.ghosts == ghosts)
        view.update()
        assert set(view.ghosts) == set(ghosts)
    view.close()


def test_a_frame_that_can_not_be_drawn_is_counted(feed: Feed, monkeypatch: pytest.MonkeyPatch):
    """The view goes on after a fault of its own, and tells it."""
    view, stop = View(feed, port=free_port()), threading.Event()

    def fail() -> None:
        raise ValueError("odd")

    monkeypatch.setattr(view, "update", fail)
    thread = threading.Thread(target=view.run, args=(stop,))
    thread.start()
    wait_for(lambda: feed.latest().faults["drawing: ValueError('odd')"] >= 2)
    stop.set()
    thread.join()
    view.close()


def test_a_port_in_use_is_told():
    """Viser would silently take the next one."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(WebError, match=rf"127.0.0.1:{port} \(Address already in use\).*--port"):
            check_port("127.0.0.1", port)
    with pytest.raises(WebError, match="--port"):
        check_port("127.0.0.1", 70_000)


def test_the_view_is_outside_of_the_rig():
    """From where one looks, the middle of the arena lies ahead and every camera is nearer than 12 m."""
    eye, target = (np.array(point) for point in frame(four_cameras()))
    assert eye[2] > target[2] > 0
    assert 3 < np.linalg.norm(eye - target) < 12
    assert frame(None)[1] != frame(None)[0]


def test_the_body_is_closed():
    """Every edge of the puck belongs to two faces, once in each direction."""
    _, faces = puck(0.1, 0.03)
    edges = [tuple(edge) for face in faces.tolist() for edge in zip(face, face[1:] + face[:1], strict=True)]
    assert sorted(edges) == sorted((b, a) for a, b in edges)
    assert len(set(edges)) == len(edges)


@pytest.mark.parametrize("data", [None, b"", b"no picture", bytes(100)])
def test_bytes_that_are_no_picture(data: bytes | None):
    """None, and no exception."""
    assert decode_jpeg(data) is None
