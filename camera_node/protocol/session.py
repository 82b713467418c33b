# SPDX-License-Identifier: BSD-3-Clause
"""Zenoh sessions with explicit endpoints: the server is a router that listens, everybody else connects to it."""

import json
import logging
import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import zenoh

from camera_node.errors import ConfigError, NetworkError

log = logging.getLogger("camera_node.network")

REPORT_S = 5.0  # for a router's report on itself
PATIENCE_S = 3.0  # how long the server may take to be seen before its absence is told
ASSIGNED_PORT = re.compile(r":0(?=[?#]|$)")  # of an endpoint whose port the operating system chooses
RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}


def open_router(listen: Sequence[str], zenoh_config: Path | None = None) -> zenoh.Session:
    """The session of a server, which is the arena's Zenoh router.

    The operating system chooses the port of an endpoint such as tcp/127.0.0.1:0; `listening_endpoints` reads it.

    Raises:
        NetworkError: an endpoint is taken or is none.
        ConfigError: the Zenoh configuration is missing or broken.
    """
    # A listening timeout other than 0 would hide that the port is taken.
    options = {"listen/endpoints": list(listen), "listen/timeout_ms": 0, "listen/exit_on_failure": True}
    if has_assigned_port(listen):
        options |= {"adminspace/enabled": True, "adminspace/permissions/read": True}
    try:
        return zenoh.open(_config(zenoh_config, options))
    except zenoh.ZError as error:
        raise NetworkError(
            f"can't listen on {' '.join(listen)}: is another server running there? Stop it or choose another "
            f"port with --listen, written as tcp/0.0.0.0:7447 ({_brief(error)})"
        ) from None


def has_assigned_port(listen: Sequence[str]) -> bool:
    """Whether the operating system chooses the port of one of the endpoints: it is given as 0."""
    return any(ASSIGNED_PORT.search(endpoint) for endpoint in listen)


def listening_endpoints(router: zenoh.Session, listen: Sequence[str]) -> tuple[str, ...]:
    """The endpoints at which a router is reached that `open_router` opened with `listen`.

    They are `listen` itself unless a port in it is 0; then they are read from the router's admin space, since Zenoh's
    Python API 1.10 does not report locators.

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


def open_client(connect: Sequence[str], zenoh_config: Path | None = None) -> zenoh.Session:
    """A session that opens at once and keeps trying to reach the router, now and after every loss.

    It is a Zenoh router that listens nowhere. A Zenoh client does not open while no router answers, and what a Zenoh
    peer publishes is not relayed by a router to other peers (measured with 1.10). What is put while the router is
    away is dropped at once.

    Raises:
        NetworkError: an endpoint is none.
        ConfigError: the Zenoh configuration is missing or broken.
    """
    options = {
        "listen/endpoints": [],
        "connect/endpoints": list(connect),
        "connect/timeout_ms": -1,  # 0 would mean one attempt
        "connect/exit_on_failure": False,
        "connect/retry": RETRY,
        "transport/unicast/open_timeout": 2000,  # of a listener that is no Zenoh: closing waits for it
    }
    try:
        return zenoh.open(_config(zenoh_config, options))
    except zenoh.ZError as error:
        raise NetworkError(
            f"can't connect to {' '.join(connect)}: write an endpoint as tcp/host:7447 ({_brief(error)})"
        ) from None


def _config(path: Path | None, options: Mapping[str, object]) -> zenoh.Config:
    """The user's Zenoh configuration or the default, with the program's own options over it.

    Scouting stays off unless the user's file turns it on.
    """
    config = _read(path) if path else zenoh.Config()
    for key in ("scouting/multicast/enabled", "scouting/gossip/enabled"):
        if config.get_json(key) == "null":
            config.insert_json5(key, "false")
    if config.get_json("scouting/delay") == "null":
        config.insert_json5("scouting/delay", "0")  # opening would wait for what scouting finds
    for key, value in {"mode": "router", **options}.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _read(path: Path) -> zenoh.Config:
    if not path.is_file():
        raise ConfigError(f"{path} does not exist; check the path of the Zenoh configuration")
    try:
        return zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise ConfigError(f"{path} is no Zenoh configuration: {_brief(error)}") from None


def _brief(error: Exception) -> str:
    """Zenoh's message without the places in its sources."""
    return " ".join(re.sub(r"\s+at /\S+\.rs:\d+\.?", "", str(error)).split())[:160]


class ServerWatch:
    """Tells once that the server is away, and once that it is back; by its liveliness token."""

    def __init__(self, session: zenoh.Session, key: str, patience_s: float = PATIENCE_S) -> None:
        self._key, self._patience_s = key, patience_s
        self._present, self._told = False, False
        self._since = time.monotonic()
        self._subscriber = session.liveliness().declare_subscriber(key, self._change, history=True)

    def tell_absence(self) -> None:
        """Called now and then: a server that was not seen since the start is told of once."""
        if not self._present and not self._told and time.monotonic() - self._since >= self._patience_s:
            self._told = True
            log.warning(
                "the server is away; what is seen meanwhile is lost, and it is tried on. "
                "Does python -m fusion run, and are --connect and --arena right? (no %s)",
                self._key,
            )

    def close(self) -> None:
        self._subscriber.undeclare()

    def _change(self, sample: zenoh.Sample) -> None:
        self._present = sample.kind == zenoh.SampleKind.PUT
        if self._present and self._told:
            log.warning("the server is there again")
            self._told = False
        self._since = time.monotonic()
