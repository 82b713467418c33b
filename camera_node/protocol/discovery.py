# SPDX-License-Identifier: BSD-3-Clause
"""Finds servers in the local network by Zenoh's scouting, and the arenas that they serve."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import zenoh

from camera_node.foundation.errors import ConfigError, NetworkError
from camera_node.protocol.session import open_client

SCOUT_S = 1.5  # scouting repeats its question after 1 s
CONNECT_S = 2.0  # to one router that was found
MAX_ROUTERS = 16
ALIVE = "*/fusion/alive"


@dataclass(frozen=True, slots=True)
class FoundArena:
    """An arena, and the endpoints at which its server is reached."""

    arena: str
    endpoints: tuple[str, ...]


def find_arenas(timeout_s: float = SCOUT_S) -> list[FoundArena]:
    """The arenas whose servers answer multicast scouting; other Zenoh routers are left out."""
    found = []
    for endpoints in _scout(timeout_s):
        try:
            with open_client(endpoints, timeout_s=CONNECT_S) as session:
                replies = session.liveliness().get(ALIVE, timeout=CONNECT_S)
                tokens = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        except (NetworkError, zenoh.ZError):
            continue
        found += [FoundArena(token.partition("/")[0], endpoints) for token in sorted(tokens)]
    return found


def choose_arena(found: Sequence[FoundArena], arena: str | None) -> FoundArena | None:
    """The arena of that name, or the only one; None if there is none.

    Raises:
        ConfigError: there are several, and no name chooses one.
    """
    matching = [each for each in found if arena in (None, each.arena)]
    if len(matching) > 1:
        names = ", ".join(f"{each.arena} at {each.endpoints[0]}" for each in matching)
        raise ConfigError(f"several arenas are in this network: {names}; choose with --arena or --connect")
    return matching[0] if matching else None


def _scout(timeout_s: float) -> list[tuple[str, ...]]:
    """The endpoints of each router that answers."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "true")
    routers: dict[str, tuple[str, ...]] = {}

    def receive(hello: zenoh.Hello) -> None:
        if len(routers) < MAX_ROUTERS:
            routers[str(hello.zid)] = tuple(hello.locators)

    scout = zenoh.scout(receive, what="router", config=config)
    threading.Event().wait(timeout_s)
    scout.stop()
    return [endpoints for endpoints in routers.values() if endpoints]
