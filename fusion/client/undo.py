# SPDX-License-Identifier: BSD-3-Clause
"""`fusion undo`: a camera that the server placed anew stands again where it stood."""

from pathlib import Path
from typing import Annotated

import tyro

from fusion.client.arena import Arena


def undo(
    *,
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",),
    arena: str = "arena",
    zenoh_config: Annotated[Path | None, tyro.conf.arg(name="zenoh")] = None,
) -> int:
    """Take back the last pose that the running server found of a moved camera, which it then leaves alone.

    Args:
        connect: the server's Zenoh endpoints.
        arena: the arena's name.
        zenoh_config: a Zenoh configuration (JSON5) for TLS, access control or scouting.
    """
    with Arena.connect(*connect, arena=arena, zenoh_config=zenoh_config) as client:
        before, after = client.rig(), client.undo_correction()
    moved = [name for name in after.cameras if before and after.cameras[name] != before.cameras.get(name)]
    print(f"{', '.join(moved) or 'the camera'} is back where it stood, and is not watched any more")
    return 0
