# SPDX-License-Identifier: BSD-3-Clause
"""Opens Zenoh sessions with explicit endpoints: the server is a router that listens, other programs connect to it.

`guarded` makes callbacks of Zenoh that never raise.
"""

import json
import logging
import re
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import zenoh

from camera_node.foundation.errors import AddressError, ConfigError, NetworkError

log = logging.getLogger("camera_node.network")

REPORT_S = 5.0  # timeout of the query for a router's endpoints
CONNECT_S = 5.0  # for a server to accept a client
NO_SERVER = (
    "no server answers at {} within {:g} s; start it with roundel up or roundel server, or correct --connect"
)
PATIENCE_S = 3.0  # time without a server after which its absence is logged
# In Zenoh's message, where the operating system refuses an address; otherwise the configuration is invalid.
SYSTEM_ERROR = re.compile(r"os error \d+|failed to lookup address")
# Of Zenoh; it retries endpoints of other protocols as if their host was away.
ENDPOINT = re.compile(r"(tcp|udp|tls|quic|ws|vsock|serial|unixsock-stream|unixpipe)/.+")
OVER = b"Timeout"  # Zenoh's own error reply
ASSIGNED_PORT = re.compile(r":0(?=[?#]|$)")  # of an endpoint whose port the operating system chooses
RETRY = {"period_init_ms": 100, "period_max_ms": 300, "period_increase_factor": 1.5}
OPEN_TIMEOUT_MS = 1000  # of one attempt; `close` waits this long for a listener that is not Zenoh
LEASE_MS = 1500  # of a silent connection, which is then re-established; TCP would retry ever more rarely
# Bytes: `messages.MAX_BYTES`, the key and the header. A receiver holds the parts of a message that is never completed,
# for each priority of each session; Zenoh's own limit is 1 GB.
MAX_MESSAGE = (1 << 22) + (1 << 16)
ALWAYS = {
    "transport/link/tx/lease": LEASE_MS,
    # A request that waits for a full link holds a lock that the end of the lease needs; Zenoh's own limit is 5 s.
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 1000 * LEASE_MS,  # us
    "transport/link/rx/max_message_size": MAX_MESSAGE,
    # It maps 16 MB for each program that sends, bypasses access rights of the network, and a killed program leaves it.
    "transport/shared_memory/enabled": False,
}
SEND_BUFFER = 8192  # bytes in the kernel: what a slow link can't carry is dropped here, before it is old
LOOPBACK = re.compile(r"\w+/(localhost|127\.[\d.]+|\[::1\]):.*")  # never slow, and with segments of 64 kB
BURST_BUFFER = 1 << 18  # for bursts of messages: a full buffer waits for an acknowledgement, 40 ms
T = TypeVar("T")


def open_router(
    listen: Sequence[str], zenoh_config: Path | None = None, others: Sequence[str] = ()
) -> zenoh.Session:
    """Open the server's session, which is the arena's Zenoh router. It connects to `others`, and retries for ever.

    The operating system chooses the port of an endpoint such as tcp/127.0.0.1:0; `listening_endpoints` reads it.

    Raises:
        AddressError: an endpoint is taken, or its address is not one of this machine now.
        NetworkError: an endpoint is invalid, or a certificate is missing.
        ConfigError: the Zenoh configuration is missing or invalid.
    """
    if wrong := [endpoint for endpoint in listen if not ENDPOINT.fullmatch(endpoint)]:
        raise NetworkError(
            f"can't listen on '{wrong[0]}': give an endpoint such as tcp/0.0.0.0:7447 (--listen)"
        )
    # With a listening timeout other than 0, opening succeeds although the port is taken.
    options = {
        "mode": "router",
        "listen/endpoints": list(listen),
        "listen/timeout_ms": 0,
        "listen/exit_on_failure": True,
    }
    if others:
        options |= {
            "connect/endpoints": list(others),
            "connect/retry": RETRY,
            "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
        }
    if has_assigned_port(listen):
        options |= {"adminspace/enabled": True, "adminspace/permissions/read": True}
    try:
        return zenoh.open(_config(zenoh_config, options))
    except zenoh.ZError as error:
        kind = AddressError if SYSTEM_ERROR.search(str(error)) else NetworkError
        raise kind(
            f"can't listen on {' '.join(listen)}: another server may use the port; stop it or choose another port "
            f"with --listen, such as tcp/0.0.0.0:7447 ({_brief(error)})"
        ) from None


def has_assigned_port(listen: Sequence[str]) -> bool:
    """Whether the port of one of the endpoints is 0, so that the operating system chooses it."""
    return any(ASSIGNED_PORT.search(endpoint) for endpoint in listen)


def listening_endpoints(router: zenoh.Session, listen: Sequence[str]) -> tuple[str, ...]:
    """The endpoints of a router that `open_router` opened with `listen`.

    They are `listen` itself unless a port in it is 0. In that case they are read from the router's admin space, because
    Zenoh's Python API 1.10 does not report locators.

    Raises:
        NetworkError: the router does not report them.
    """
    if not has_assigned_port(listen):
        return tuple(listen)
    for reply in router.get(f"@/{router.info.zid()}/router", timeout=REPORT_S):
        if reply.ok is not None and (locators := json.loads(reply.ok.payload.to_bytes()).get("locators")):
            return tuple(locators)
    raise NetworkError(
        f"the Zenoh router does not report the ports of {' '.join(listen)}; give a port instead of 0 in --listen"
    )


def open_client(
    connect: Sequence[str], zenoh_config: Path | None = None, timeout_s: float = CONNECT_S
) -> zenoh.Session:
    """Open a session with a server that runs, as a Zenoh client; it reconnects after every loss.

    Publications are dropped while the session is not connected. Programs that may start before the server use
    `ServerConnection`.

    Raises:
        NetworkError: an endpoint is invalid, or no server answers within `timeout_s`.
        ConfigError: the Zenoh configuration is missing or invalid.
    """
    limits = {"connect/timeout_ms": round(timeout_s * 1000), "connect/exit_on_failure": True}
    try:
        return _open_client(connect, zenoh_config, limits)
    except zenoh.ZError as error:
        cause = "" if "Timeout" in str(error) else f" ({_brief(error)})"
        raise NetworkError(NO_SERVER.format(" ".join(connect), timeout_s) + cause) from None


def open_endless(
    connect: Sequence[str], zenoh_config: Path | None = None, send_buffer: int | None = None
) -> zenoh.Session:
    """As `open_client`, but tries until a server answers: for threads that are daemons.

    Args:
        connect: endpoints of the server.
        zenoh_config: a file.
        send_buffer: of the kernel, bytes; None for that of `send_buffer_of`.

    Raises:
        NetworkError: an endpoint is invalid, or a certificate is missing.
        ConfigError: the Zenoh configuration is missing or invalid.
    """
    limits = {"connect/timeout_ms": -1, "connect/exit_on_failure": False}
    buffers = {} if send_buffer is None else _send_buffers(send_buffer)
    try:
        return _open_client(connect, zenoh_config, {**limits, **buffers})
    except zenoh.ZError as error:
        raise NetworkError(f"can't connect to {' '.join(connect)}: {_brief(error)}") from None


def _open_client(
    connect: Sequence[str], zenoh_config: Path | None, limits: Mapping[str, object]
) -> zenoh.Session:
    if invalid := [endpoint for endpoint in connect if not ENDPOINT.fullmatch(endpoint)]:
        raise NetworkError(f"can't connect to '{invalid[0]}': give an endpoint such as tcp/host:7447")
    options = {
        "mode": "client",
        "listen/endpoints": [],
        "connect/endpoints": list(connect),
        "connect/retry": RETRY,
        "transport/unicast/open_timeout": OPEN_TIMEOUT_MS,
        **_send_buffers(send_buffer_of(connect)),
        "transport/link/tx/queue/size/real_time": 1,  # batches
    }
    return zenoh.open(_config(zenoh_config, {**options, **limits}))


def send_buffer_of(connect: Sequence[str]) -> int:
    """The bytes of the kernel's send buffer: as few as a slow link needs, and enough for large messages on loopback.

    On loopback a segment has 64 kB. A smaller buffer is never full of segments, so the receiver delays its
    acknowledgement by 25 to 40 ms, in which a message of more than 16 kB waits and the next one is dropped.
    """
    return BURST_BUFFER if all(map(LOOPBACK.fullmatch, connect)) else SEND_BUFFER


def _send_buffers(size: int) -> dict[str, int]:
    return {f"transport/link/{protocol}/so_sndbuf": size for protocol in ("tcp", "tls")}


def is_from_router(session: zenoh.Session, reply: zenoh.Reply) -> bool:
    """Whether a router that this session is connected to sent the reply: the server, unless routers are between them.

    Without access control any client may answer a query. Zenoh names the sender in each reply.
    """
    return reply.replier_id is not None and reply.replier_id.zid in session.info.routers_zid()


def ask_server(
    session: zenoh.Session, key: str, timeout_s: float, payload: bytes = b"", attachment: bytes | None = None
) -> zenoh.Reply | None:
    """The reply of a router that this session is connected to; if there is none, the first reply, None without any.

    Zenoh's error reply when the time is over is no reply.

    Raises:
        NetworkError: the session is closed.
    """
    every = zenoh.ConsolidationMode.NONE  # otherwise Zenoh drops all replies but one
    try:
        replies = session.get(
            key, payload=payload, attachment=attachment, consolidation=every, timeout=timeout_s
        )
    except zenoh.ZError as error:
        raise NetworkError(f"{key} can't be queried: {_brief(error)}") from None
    first = None
    for reply in replies:
        if reply.err is not None and reply.err.payload.to_bytes() == OVER:
            continue
        if is_from_router(session, reply):
            return reply
        first = first or reply
    return first


def _config(path: Path | None, options: Mapping[str, object]) -> zenoh.Config:
    """The user's Zenoh configuration or the default one, overridden by the program's own options.

    Scouting is off unless the user's file enables it.
    """
    config = read_config(path) if path else zenoh.Config()
    for key in ("scouting/multicast/enabled", "scouting/gossip/enabled"):
        if config.get_json(key) == "null":
            config.insert_json5(key, "false")
    if config.get_json("scouting/delay") == "null":
        config.insert_json5("scouting/delay", "0")  # otherwise opening waits for scouting
    for key, value in {**ALWAYS, **options}.items():
        config.insert_json5(key, json.dumps(value))
    return config


def read_config(path: Path) -> zenoh.Config:
    """Read a Zenoh configuration. Raises ConfigError if it is missing or invalid."""
    if not path.is_file():
        raise ConfigError(f"{path} does not exist; check the path of the Zenoh configuration")
    try:
        return zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise ConfigError(f"{path} is not a valid Zenoh configuration: {_brief(error)}") from None


def _brief(error: Exception) -> str:
    """Zenoh's error message without the locations in its source code."""
    return " ".join(re.sub(r"\s+at /\S+\.rs:\d+\.?", "", str(error)).split())[:160]


class ServerWatch:
    """Logs once that the server is away and once that it is back, according to its liveliness token."""

    def __init__(self, session: zenoh.Session, key: str, patience_s: float = PATIENCE_S) -> None:
        self._key, self._patience_s = key, patience_s
        self._present, self._reported = False, False
        self._since = time.monotonic()
        self._subscriber = session.liveliness().declare_subscriber(key, self._change, history=True)

    def report_absence(self) -> None:
        """Log that the server is away, once for each absence longer than `patience_s`; to be called periodically."""
        if not self._present and not self._reported and time.monotonic() - self._since >= self._patience_s:
            self._reported = True
            log.warning(
                "the server is away; detections are dropped until it returns; retrying. "
                "Check that roundel server runs and that --connect and --arena are right (no %s)",
                self._key,
            )

    def close(self) -> None:
        self._subscriber.undeclare()

    def _change(self, sample: zenoh.Sample) -> None:
        self._present = sample.kind == zenoh.SampleKind.PUT
        if self._present and self._reported:
            log.warning("the server is back")
            self._reported = False
        self._since = time.monotonic()


def guarded(
    purpose: str, callback: Callable[[T], object], count_fault: Callable[[], object] = lambda: None
) -> Callable[[T], None]:
    """The callback, whose exceptions are logged and counted.

    Of an exception Zenoh would print the traceback, and a query would wait for its timeout.

    Args:
        purpose: the subject of the log line, such as "a callback for poses".
        callback: takes what Zenoh received.
        count_fault: is called after an exception.
    """

    def call(received: T) -> None:
        try:
            callback(received)
        except Exception:  # whatever a network can cause
            count_fault()
            log.exception("%s failed %s", purpose, getattr(received, "key_expr", ""))

    return call
