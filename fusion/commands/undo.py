# SPDX-License-Identifier: BSD-3-Clause
"""`fusion undo`: restores the camera that the server recalibrated last."""

from pathlib import Path
from typing import Annotated

import tyro

from camera_node.terminal import say
from fusion.client.arena import Arena


def undo(
    *,
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",),
    arena: str = "arena",
    zenoh_config: Annotated[Path | None, tyro.conf.arg(name="zenoh")] = None,
) -> int:
    """Undo the last recalibration of a moved camera by the running server, which no longer monitors that camera.

    Args:
        connect: the server's Zenoh endpoints.
        arena: the arena's name.
        zenoh_config: a Zenoh configuration (JSON5) for TLS, access control or scouting.
    """
    with Arena.connect(*connect, arena=arena, zenoh_config=zenoh_config) as client:
        before, after = client.rig(), client.undo_correction()
    changed = [name for name in after.cameras if before and after.cameras[name] != before.cameras.get(name)]
    say(f"{', '.join(changed) or 'the camera'} has its previous pose again and is no longer monitored")
    return 0
