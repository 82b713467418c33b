# SPDX-License-Identifier: BSD-3-Clause
"""Zenoh sessions with explicit endpoints: the server is a router that listens, everybody else connects to it."""

import json
from collections.abc import Sequence
from pathlib import Path

import zenoh

from camera_node.errors import ConfigError, NetworkError


def open_router(listen: Sequence[str], zenoh_config: Path | None = None) -> zenoh.Session:
    """The session of a server, which is the arena's Zenoh router.

    Raises:
        NetworkError: an endpoint is taken or is none.
    """
    config = _config(zenoh_config)
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps(list(listen)))
    config.insert_json5("listen/exit_on_failure", "true")
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = " ".join(listen)
        raise NetworkError(
            f"can't listen on {where}: is another server running there? Stop it or choose another port "
            f"with --listen ({_brief(error)})"
        ) from None


def open_client(connect: Sequence[str], zenoh_config: Path | None = None) -> zenoh.Session:
    """A session that opens at once and keeps trying to reach the router, now and after every loss.

    It is a peer that listens nowhere: unlike a Zenoh client it opens while no router answers.

    Raises:
        NetworkError: an endpoint is none.
    """
    config = _config(zenoh_config)
    config.insert_json5("mode", '"peer"')
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("connect/endpoints", json.dumps(list(connect)))
    config.insert_json5("connect/timeout_ms", "0")
    config.insert_json5("connect/exit_on_failure", "false")
    config.insert_json5(
        "connect/retry",
        '{"period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 1.5}',
    )
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise NetworkError(
            f"can't connect to {' '.join(connect)}: write an endpoint as tcp/host:7447 ({_brief(error)})"
        ) from None


def _config(path: Path | None) -> zenoh.Config:
    """The user's Zenoh configuration, or the default, with scouting off unless the user's file turns it on."""
    if path is None:
        config = zenoh.Config()
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("scouting/gossip/enabled", "false")
        return config
    if not path.is_file():
        raise ConfigError(f"{path} does not exist; check the path of the Zenoh configuration")
    try:
        return zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise ConfigError(f"{path} is no Zenoh configuration: {_brief(error)}") from None


def _brief(error: Exception) -> str:
    return str(error).splitlines()[0][:160]
