# SPDX-License-Identifier: BSD-3-Clause
"""`roundel doctor`: checks a machine, the files of an arena and a running server, and says what to do."""

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
import tyro

from camera_node.foundation.errors import NetworkError, RoundelError
from camera_node.foundation.terminal import say
from fusion.client.arena import Arena
from fusion.diagnosis.findings import (
    Finding,
    Observation,
    check_arena,
    check_certificates,
    check_disk,
    check_files,
    check_listening,
    check_versions,
    observe,
)
from fusion.server.arena_config import ArenaConfig, load_arena


def doctor(
    *,
    config: Path | None = None,
    connect: tuple[str, ...] | None = None,
    arena: str | None = None,
    zenoh_config: Annotated[Path | None, tyro.conf.arg(name="zenoh")] = None,
    timeout_s: float = 5.0,
    json: bool = False,
) -> int:
    """Check versions, ports, certificates, disk, rig and robots, and with a running server its cameras and clocks.

    The exit code is 0 if all is well, and 1 otherwise.

    Args:
        config: the server's arena.yaml, on the server's machine.
        connect: the server's Zenoh endpoints; those of the configuration unless given.
        arena: the arena's name; that of the configuration unless given.
        zenoh_config: a Zenoh configuration (JSON5) to connect with.
        timeout_s: how long to wait for the server, seconds.
        json: print the findings as one JSON list.
    """
    findings = list(_findings(config, connect, arena, zenoh_config, timeout_s))
    if json:
        say(msgspec.json.encode(findings).decode())
    else:
        for finding in findings:
            say(finding.line)
    return int(any(finding.level != "ok" for finding in findings))


def _findings(
    path: Path | None,
    connect: tuple[str, ...] | None,
    arena: str | None,
    zenoh_config: Path | None,
    timeout_s: float,
) -> Iterator[Finding]:
    now, config = datetime.now(UTC), ArenaConfig()
    yield check_versions()
    if path is not None:
        try:
            config = load_arena(path)
            yield Finding("ok", "configuration", str(path))
        except RoundelError as error:
            yield Finding("error", "configuration", str(error))
            return
    endpoints = connect or tuple(e.replace("0.0.0.0", "127.0.0.1") for e in config.listen)
    try:
        observation, absence = _observe(endpoints, arena or config.arena, zenoh_config, timeout_s), ""
    except NetworkError as error:
        observation, absence = None, str(error)
    if path is not None:
        server_config = Path(config.zenoh) if config.zenoh else None
        yield from check_listening(config, observation is not None)
        yield from check_certificates(server_config, now)
        yield check_disk(path.parent)
        yield from check_files(config, now)
    else:
        yield from check_certificates(zenoh_config, now)
        yield check_disk(Path())
    if observation is None:
        yield Finding("warning", "server", absence)
        return
    yield Finding("ok", "server", f"answers at {' '.join(endpoints)}")
    yield from check_arena(observation, now)


def _observe(
    endpoints: tuple[str, ...], arena: str, zenoh_config: Path | None, timeout_s: float
) -> Observation:
    with Arena.connect(*endpoints, arena=arena, zenoh_config=zenoh_config) as client:
        return observe(client, timeout_s)
