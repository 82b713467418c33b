# SPDX-License-Identifier: BSD-3-Clause
"""Who may use the page: its tokens, the sites that may connect to it, and the messages that each role may send.

Viser has no hook for this. It serves the page with `websockets.asyncio.server.serve`, whose parameters
`process_request` and `create_connection` are made for it: `guarding` adds them while Viser starts.
"""

import contextlib
import hmac
import ipaddress
import logging
import os
import secrets
import socket
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Any, Literal
from urllib.parse import parse_qs, urlsplit

import msgspec
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response
from websockets.typing import Data

from camera_node.foundation.config import load_yaml
from camera_node.foundation.errors import ConfigError, printable, unwritable
from web.errors import WebError
from web.html_tables import add_folder_keys

log = logging.getLogger("web.page")

Role = Literal["operator", "viewer"]
Handler = Callable[[ServerConnection, Request], Response | None]

MAX_MESSAGE = 1 << 16  # bytes from a browser; the longest are clicks and typed names
MIN_TOKEN = 16  # characters
MAX_CONNECTIONS = 768  # of 1,024 files that a process may open by default; the page needs some hundred itself
MAX_OF_ADDRESS = 256  # connections of one machine or proxy; a browser has one, and six while it loads
VIEWER_MESSAGES = frozenset({"ViewerCameraMessage"})  # the viewpoint of the browser itself
OPERATOR_MESSAGES = VIEWER_MESSAGES | {"GuiUpdateMessage", "ScenePointerMessage", "CommandTriggerMessage"}
HEADERS = {  # of each file: no other site may show the page in a frame, or learn its address
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}

current_role: ContextVar[Role] = ContextVar("current_role")  # of the browser whose connection is being served


class Tokens(msgspec.Struct, frozen=True):
    """The secrets that give a browser a role."""

    operator: str
    viewer: str

    @classmethod
    def random(cls) -> "Tokens":
        return cls(operator=secrets.token_urlsafe(24), viewer=secrets.token_urlsafe(24))

    @classmethod
    def load(cls, path: Path) -> "Tokens":
        """Read a file of tokens; create it with random ones if it does not exist.

        Raises:
            ConfigError: the file is invalid, its tokens are short or equal, or other users can read it.
        """
        with contextlib.suppress(FileExistsError):
            _create_private(path, msgspec.yaml.encode(cls.random()))
        tokens = load_yaml(path, cls)
        if path.stat().st_mode & 0o077:
            raise ConfigError(f"{path} is readable by other users; run chmod 600 {path}")
        if min(map(len, (tokens.operator, tokens.viewer))) < MIN_TOKEN or tokens.operator == tokens.viewer:
            raise ConfigError(f"{path}: give two different tokens of at least {MIN_TOKEN} characters")
        return tokens

    def role(self, token: str) -> Role | None:
        """The role of a token, found in constant time; None of a wrong one."""
        is_operator, is_viewer = (
            hmac.compare_digest(token.encode(), known.encode()) for known in (self.operator, self.viewer)
        )
        return "operator" if is_operator else "viewer" if is_viewer else None


def _create_private(path: Path, data: bytes) -> None:
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(data)
    except FileExistsError:
        raise
    except OSError as error:
        raise unwritable(path, error) from None


class Refusal(Exception):
    """The response to a request that is not allowed."""

    def __init__(self, status: HTTPStatus, text: str) -> None:
        super().__init__(text)
        self.status = status


@dataclass(frozen=True)
class PageAccess:
    """Who may use a page.

    Attributes:
        host: the address that the page is bound to.
        port: its port.
        tokens: give the roles; None if every visitor is an operator, which requires a loopback address.
        origins: further origins of the page, of reverse proxies.
    """

    host: str
    port: int
    tokens: Tokens | None
    origins: frozenset[str] = frozenset()

    @classmethod
    def create(
        cls, host: str, port: int, tokens_file: Path | None = None, origins: Sequence[str] = ()
    ) -> "PageAccess":
        """Tokens are required beyond loopback and behind a proxy: those of the file, or random ones.

        Raises:
            ConfigError: the file is invalid.
        """
        if tokens_file is not None:
            tokens = Tokens.load(tokens_file)
        else:
            tokens = None if is_loopback(host) and not origins else Tokens.random()
        return cls(host, port, tokens, frozenset(origins))

    @property
    def address(self) -> str:
        """The page's address, without a token."""
        host = socket.gethostname() if self.host in ("", "0.0.0.0", "::") else self.host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}"

    def url(self, role: Role) -> str:
        """An address of the page that gives a role."""
        return f"{self.address}/?token={getattr(self.tokens, role)}"

    def instructions(self, tokens_file: Path | None = None) -> list[str]:
        """Lines that tell a user what to open; they name the file of the tokens instead of its tokens."""
        if self.tokens is None:
            return [f"open {self.address} in a browser; Ctrl-C ends"]
        if tokens_file is not None:
            return [
                f"open {self.address}/?token=TOKEN in a browser, with a token of {tokens_file}; Ctrl-C ends"
            ]
        return [
            f"operator: open {self.url('operator')} in a browser; Ctrl-C ends",
            f"viewer, who can't change anything: open {self.url('viewer')}",
        ]

    def role_of(self, request: Request) -> Role:
        """The role of the sender of a request.

        Raises:
            Refusal: the token is missing or wrong, or the page of another site sent the request.
        """
        host, origin = _header(request, "Host"), _header(request, "Origin")
        if self.tokens is None and not is_loopback(urlsplit(f"//{host}").hostname or ""):
            # A name of another site that resolves to loopback (DNS rebinding).
            raise Refusal(HTTPStatus.FORBIDDEN, f"open this page as localhost:{self.port}")
        if origin and urlsplit(origin).netloc != host and origin not in self.origins:
            raise Refusal(HTTPStatus.FORBIDDEN, "pages of other sites may not use this page")
        if self.tokens is None:
            return "operator"
        role = self.tokens.role(_token_of(request) or self._cookie(request))
        if role is None:
            raise Refusal(
                HTTPStatus.UNAUTHORIZED, "open the address with the token that roundel view printed"
            )
        return role

    def answer(self, connection: ServerConnection, request: Request, serve_file: Handler) -> Response | None:
        """The response to an HTTP request, or None to accept a WebSocket of an allowed role."""
        try:
            role = self.role_of(request)
        except Refusal as refusal:
            log.warning("refused a browser at %s: %s", _address(connection), refusal)
            return connection.respond(refusal.status, f"{refusal}\n")
        current_role.set(role)
        response = serve_file(connection, request)
        token = _token_of(request)
        if response is not None and token and self.tokens is not None:
            response = connection.respond(HTTPStatus.SEE_OTHER, "")
            response.headers["Location"] = "./"  # so that the token does not stay in the browser's history
            response.headers["Cache-Control"] = "no-store"
            response.headers["Set-Cookie"] = f"{self._cookie_name}={token}; Path=/; HttpOnly; SameSite=Lax"
        if response is not None:
            add_folder_keys(response)
            response.headers.update(HEADERS)
        return response

    @property
    def _cookie_name(self) -> str:
        return f"roundel_{self.port}"  # browsers do not separate cookies by port

    def _cookie(self, request: Request) -> str:
        try:
            cookie = SimpleCookie(_header(request, "Cookie")).get(self._cookie_name)
        except CookieError:
            return ""
        return cookie.value if cookie else ""


def is_loopback(host: str) -> bool:
    """Whether a host name or address is this machine's loopback."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _header(request: Request, name: str) -> str:
    return ", ".join(request.headers.get_all(name))


def _token_of(request: Request) -> str:
    """The token in the address of a request, or an empty text."""
    return parse_qs(urlsplit(request.path).query).get("token", [""])[0]


def _address(connection: ServerConnection) -> str:
    return str((connection.remote_address or ("?",))[0])


class BrowserMessage(msgspec.Struct):
    """What the guard reads of a message from a browser."""

    type: str
    updates: dict[str, Any] = {}


_decoder = msgspec.msgpack.Decoder(BrowserMessage)


def is_allowed(data: Data, role: Role) -> bool:
    """Whether a browser of a role may send a message: a viewer its viewpoint, an operator clicks and values too.

    Viser's own handlers would let each browser open a public tunnel to the page (`ShareUrlRequest`), and overwrite any
    attribute of a control (`GuiUpdateMessage`).
    """
    try:
        message = _decoder.decode(data if isinstance(data, bytes) else b"")
    except (msgspec.MsgspecError, RecursionError):
        return False
    if message.type not in OPERATOR_MESSAGES:
        log.warning("refused a browser's message %s", printable(message.type[:40]))
    messages = OPERATOR_MESSAGES if role == "operator" else VIEWER_MESSAGES
    return message.type in messages and set(message.updates) <= {"value"}


class OpenConnections:
    """How many connections are open, of each address and of all; those beyond the limits are ended at once.

    A process has 1,024 files unless its service permits more: without a limit, one machine takes all of them.
    """

    def __init__(self) -> None:
        self._of_address: Counter[str] = Counter()

    def admit(self, address: str) -> bool:
        """Count a connection, and return whether it is within the limits."""
        self._of_address[address] += 1
        is_within = (
            self._of_address[address] <= MAX_OF_ADDRESS and self._of_address.total() <= MAX_CONNECTIONS
        )
        if not is_within:
            log.warning("refused a browser at %s: %d connections are open", address, self._of_address.total())
        return is_within

    def remove(self, address: str) -> None:
        """A connection ended."""
        self._of_address[address] -= 1
        if not self._of_address[address]:
            del self._of_address[address]


class GuardedConnection(ServerConnection):
    """A browser's connection that drops the messages that its role may not send, and ends if too many are open."""

    open_connections: OpenConnections
    _counted_address: str | None = None

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._counted_address = _address(self)
        if not self.open_connections.admit(self._counted_address):
            transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._counted_address is not None:
            self.open_connections.remove(self._counted_address)
        super().connection_lost(exc)

    async def recv(self, decode: bool | None = None) -> Any:
        while True:
            data = await super().recv(decode)
            if is_allowed(data, current_role.get()):
                return data


@contextlib.contextmanager
def guarding(access: PageAccess) -> Iterator[None]:
    """Guard the page that Viser starts to serve inside the block.

    Raises:
        WebError: Viser did not use `websockets.asyncio.server.serve`, so the page would not be guarded.
    """
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # a probe of the port is no fault
    serve, guarded = websockets.asyncio.server.serve, False

    def serve_guarded(*arguments: Any, process_request: Handler, **options: Any) -> Any:
        nonlocal guarded
        guarded = True

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            return access.answer(connection, request, process_request)

        kind = type("PageConnection", (GuardedConnection,), {"open_connections": OpenConnections()})
        options |= {"create_connection": kind, "max_size": MAX_MESSAGE}
        return serve(*arguments, process_request=answer, **options)

    websockets.asyncio.server.serve = serve_guarded  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve
    if not guarded:
        raise WebError("this version of viser can't be guarded; install viser>=1.1,<2")
