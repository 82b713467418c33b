# SPDX-License-Identifier: BSD-3-Clause
"""The page's tokens, origins and roles, with raw WebSocket clients, HTTP requests and a browser."""

import contextlib
import http.client
import re
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import pytest
import viser
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.frames import CloseCode
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from camera_node.foundation.errors import ConfigError
from tests.conftest import free_port
from tests.waiting import DEADLINE_S, Inbox, wait_for
from tests.web.browser import browsing, drawing
from web.page_access import MAX_MESSAGE, MAX_OF_ADDRESS, PageAccess, Tokens, is_loopback
from web.state.feed import Feed
from web.view import READ_ONLY, View

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 0.0),
    "fov": 1.0,
    "near": 0.1,
    "far": 100.0,
    "image_height": 600,
    "image_width": 800,
    "look_at": (1.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}
PROXY = "https://lab.example.org"


class Page:
    """A page without an arena, and its clients."""

    def __init__(self, access: PageAccess, closing: ExitStack) -> None:
        self.access, self._closing = access, closing
        self.view = View(Feed("test"), access)
        closing.callback(self.view.close)
        self._marks = count(1)
        self.clicks = Inbox()
        self.button = self.view.server.gui.add_button("Change the rig")
        self.button.on_click(lambda _: self.clicks.put("click"))

    def connect(self, token: str = "", **headers: str) -> Connection:
        """A WebSocket client as the page's script; Origin and Cookie are in `headers`."""
        query = f"/?token={token}" if token else "/"
        return self._closing.enter_context(
            connect(
                f"ws://127.0.0.1:{self.access.port}{query}",
                subprotocols=[f"viser-v{viser.__version__}"],  # pyright: ignore[reportArgumentType]
                additional_headers=headers,
                max_size=None,
                compression=None,
            )
        )

    def get(self, path: str = "/", **headers: str) -> http.client.HTTPResponse:
        connection = http.client.HTTPConnection("127.0.0.1", self.access.port, timeout=DEADLINE_S)
        self._closing.callback(connection.close)
        connection.request("GET", path, headers=headers)
        return connection.getresponse()

    def press(self, **updates: Any) -> dict[str, Any]:
        """The message of a click on the button."""
        return {
            "type": "GuiUpdateMessage",
            "uuid": self.button._impl.uuid,
            "updates": updates or {"value": True},
        }

    def send(self, client: Connection, *messages: dict[str, Any] | bytes) -> None:
        """Send messages, then a viewpoint, and wait until the page has received all."""
        mark = float(next(self._marks))
        for message in ({**CAMERA}, *messages, {**CAMERA, "position": (mark, 0.0, 0.0)}):
            client.send(message if isinstance(message, bytes) else msgspec.msgpack.encode(message))
        wait_for(lambda: any(c.camera.position[0] == mark for c in self.view.server.get_clients().values()))


@pytest.fixture
def closing() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def local(closing: ExitStack) -> Page:
    """A page on loopback, without tokens."""
    return Page(PageAccess.create("127.0.0.1", free_port()), closing)


@pytest.fixture
def shared(closing: ExitStack) -> Page:
    """A page for the whole network."""
    return Page(PageAccess.create("0.0.0.0", free_port()), closing)


def refusal(page: Page, token: str = "", **headers: str) -> int:
    """The HTTP status with which the page refuses a WebSocket."""
    with pytest.raises(InvalidStatus) as caught:
        page.connect(token, **headers)
    return caught.value.response.status_code


def drain(client: Connection) -> None:
    """Receive until the page closes the connection or sends nothing."""
    while client.recv(DEADLINE_S):
        pass


def tokens_of(page: Page) -> Tokens:
    assert page.access.tokens is not None
    return page.access.tokens


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:1", "http://127.0.0.1.evil.example"]
)
def test_another_site_cannot_use_the_page(local: Page, shared: Page, origin: str):
    """As a page of that site in the operator's browser would, which sends the operator's cookie."""
    assert refusal(local, Origin=origin) == 403
    assert refusal(shared, tokens_of(shared).operator, Origin=origin) == 403


def test_the_page_itself_may_connect(local: Page):
    own = f"127.0.0.1:{local.access.port}"
    assert local.connect(Origin=f"http://{own}").recv()
    assert local.connect().recv(), "programs that are no browser send no origin"


def test_a_foreign_name_that_resolves_to_loopback_is_refused(local: Page):
    """DNS rebinding: the browser takes the page for one of evil.example."""
    name = f"evil.example:{local.access.port}"
    assert local.get(Host=name).status == 403
    assert local.get(Host=f"localhost:{local.access.port}").status == 200


def test_no_site_may_frame_the_page(local: Page):
    """Otherwise it could direct the operator's clicks."""
    assert local.get().headers["Content-Security-Policy"] == "frame-ancestors 'none'"


@pytest.mark.parametrize("token", ["", "wrong", "x" * 32, "\u00e9"])
def test_beyond_loopback_a_token_is_required(shared: Page, token: str):
    quoted = token.encode("unicode_escape").decode()
    assert refusal(shared, quoted) == 401
    assert shared.get(f"/?token={quoted}").status == 401
    assert shared.get("/", Cookie=f"roundel_{shared.access.port}={quoted}").status == 401
    assert b"token" in shared.get("/index.html").read()


@pytest.mark.parametrize("role", ["operator", "viewer"])
def test_the_address_with_a_token_sets_a_cookie(shared: Page, role: str):
    """The token does not stay in the address; scripts and other sites can't use the cookie."""
    reply = shared.get(f"/?token={getattr(tokens_of(shared), role)}")
    assert (reply.status, reply.headers["Location"]) == (303, "./")
    cookie, *attributes = reply.headers["Set-Cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Lax"} <= set(attributes)
    assert shared.get("/", Cookie=cookie).status == 200
    assert shared.connect(Cookie=f"other=1; {cookie}").recv()


def test_an_operator_changes_things_and_a_viewer_does_not(shared: Page):
    tokens = tokens_of(shared)
    shared.send(shared.connect(tokens.viewer), shared.press())
    assert shared.clicks.items == []
    shared.send(shared.connect(tokens.operator), shared.press())
    assert shared.clicks.until(lambda items: items == ["click"])


@pytest.mark.parametrize("kind", ["ShareUrlRequest", "ShareUrlDisconnect"])
def test_nobody_opens_a_public_tunnel(local: Page, kind: str, capfd: pytest.CaptureFixture[str]):
    """Viser would print "Share URL requested" or "Tried to disconnect from share URL"."""
    local.send(local.connect(), {"type": kind}, local.press())
    assert local.clicks.until(lambda items: items == ["click"]), "the messages were processed"
    assert "hare URL" not in capfd.readouterr().out


def test_a_browser_changes_values_only(local: Page):
    """Viser would set any attribute of the control."""
    local.send(
        local.connect(), local.press(visible=False), local.press(label="hacked"), local.press(update_cb=[])
    )
    assert (local.button.visible, local.button.label) == (True, "Change the rig")
    local.send(local.connect(), local.press())
    assert local.clicks.until(lambda items: items == ["click"])


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x91" * 50_000, msgspec.msgpack.encode({"type": 1}), b"[]"])
def test_invalid_messages_are_dropped(local: Page, data: bytes):
    local.send(local.connect(), data)


def test_long_messages_close_the_connection(local: Page):
    client = local.connect()
    client.send(b"\x00" * (MAX_MESSAGE + 1))
    with pytest.raises(ConnectionClosedError) as caught:
        drain(client)
    assert caught.value.rcvd is not None
    assert caught.value.rcvd.code == CloseCode.MESSAGE_TOO_BIG


def test_a_proxy_s_origin_is_allowed_and_requires_a_token(closing: ExitStack):
    page = Page(PageAccess.create("127.0.0.1", free_port(), origins=(PROXY,)), closing)
    assert refusal(page, Origin=PROXY) == 401
    assert page.connect(tokens_of(page).viewer, Origin=PROXY).recv()


def test_a_file_keeps_the_tokens(tmp_path: Path):
    path = tmp_path / "tokens.yaml"
    first = Tokens.load(path)
    assert path.stat().st_mode & 0o077 == 0
    assert Tokens.load(path) == first
    assert first.role(first.operator) == "operator"
    assert first.role(first.viewer) == "viewer"
    assert first.role(first.viewer[:-1]) is None
    assert Tokens.random() != Tokens.random()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("operator: short\nviewer: " + "v" * 20, "at least 16 characters"),
        ("operator: " + "v" * 20 + "\nviewer: " + "v" * 20, "two different tokens"),
        ("operator: 1\n", "tokens.yaml"),
    ],
)
def test_an_invalid_file_of_tokens_is_an_error(tmp_path: Path, text: str, reason: str):
    path = tmp_path / "tokens.yaml"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(ConfigError, match=reason):
        Tokens.load(path)


def test_a_file_of_tokens_that_others_can_read_is_an_error(tmp_path: Path):
    path = tmp_path / "tokens.yaml"
    Tokens.load(path)
    path.chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        Tokens.load(path)


@pytest.mark.parametrize(
    ("host", "expected"),
    [("127.0.0.1", True), ("127.1.2.3", True), ("::1", True), ("localhost", True)]
    + [(host, False) for host in ("0.0.0.0", "", "::", "10.0.0.1", "lab", "localhost.evil.example")],
)
def test_loopback_needs_no_token(host: str, expected: bool):
    assert is_loopback(host) == expected
    assert (PageAccess.create(host, 1).tokens is None) == expected


def test_printed_addresses_have_the_tokens(tmp_path: Path):
    """Except those of a file, which should not be in a log."""
    access = PageAccess.create("0.0.0.0", 80)
    lines = "\n".join(access.instructions())
    assert access.tokens is not None
    assert {access.tokens.operator, access.tokens.viewer} == set(re.findall(r"token=(\S+)", lines))
    access = PageAccess.create("0.0.0.0", 80, tmp_path / "tokens.yaml")
    lines = "\n".join(access.instructions(tmp_path / "tokens.yaml"))
    assert access.tokens is not None
    assert access.tokens.operator not in lines
    assert "tokens.yaml" in lines


@contextmanager
def open_as(page: Page, role: str) -> Iterator[Any]:
    url = f"http://127.0.0.1:{page.access.port}/?token={getattr(tokens_of(page), role)}"
    with browsing(page.view, url) as browser:
        yield browser


def test_a_browser_of_each_role(closing: ExitStack):
    """A viewer sees the page and a note; a click has no effect. The operator's click has one."""
    page = Page(PageAccess.create("0.0.0.0", free_port()), closing)
    closing.enter_context(drawing(page.view))
    with open_as(page, "viewer") as browser:
        browser.get_by_text("Read only").wait_for()
        assert "token" not in browser.url
        button = browser.get_by_role("button", name="Change the rig")
        assert button.evaluate("b => getComputedStyle(b).pointerEvents") == "none", (
            "dimmed, out of the mouse's reach"
        )
        button.dispatch_event("click")
    with open_as(page, "operator") as browser:
        browser.get_by_role("button", name="Change the rig").click()
        assert page.clicks.until(lambda items: items)
        assert browser.get_by_text(READ_ONLY[2:11]).count() == 0
    assert page.clicks.items == ["click"], "the operator's"


def test_one_address_keeps_no_other_one_out(local: Page, closing: ExitStack):
    """Its connections beyond the limit are ended at once, also those that never ask for anything."""
    address = ("127.0.0.1", local.access.port)
    for _ in range(MAX_OF_ADDRESS):
        closing.enter_context(socket.create_connection(address, DEADLINE_S, ("127.0.0.2", 0)))
    excess = closing.enter_context(socket.create_connection(address, DEADLINE_S, ("127.0.0.2", 0)))
    with contextlib.suppress(ConnectionResetError):
        assert excess.recv(1) == b""
    assert local.get().status == 200
