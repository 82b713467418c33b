# SPDX-License-Identifier: BSD-3-Clause
"""Writes the results of commands: rigs with their provenance, and images; hands rigs over to the server."""

import os
import shlex
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.live.rig_requests import set_rig
from calib.rig.rig import Rig, save_rig
from camera_node.foundation.errors import ConfigError, NetworkError, unwritable
from camera_node.foundation.terminal import say
from camera_node.protocol.requests import RequestError
from camera_node.protocol.server_connection import Connection


def check_folder(out: Path) -> None:
    """Raise ConfigError if `out` can't be written; called before any work is done."""
    if not out.parent.is_dir():
        raise ConfigError(f"{out.parent} is not a folder; give --out a file in a folder that exists")
    if not os.access(out.parent, os.W_OK):
        raise ConfigError(f"{out.parent} can't be written to; give --out a file in another folder")
    if out.is_dir():
        raise ConfigError(f"{out} is a folder; give --out a file such as {out / 'rig.yaml'}")


def write_rig(rig: Rig, out: Path) -> None:
    """Write the rig and print its path, and that of the backup."""
    backup = save_rig(rig, out)
    say(f"wrote {out}" + (f"; the previous rig is saved as {backup.name}" if backup else ""))


def save_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an image as PNG.

    Raises:
        ConfigError: the folder can't be made or written to.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    except OSError as error:
        raise unwritable(path, error) from None


def provenance() -> dict[str, Any]:
    """Date and command, for the `calibration` map of a rig."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": shlex.join(["roundel", "calibrate", *sys.argv[1 + (sys.argv[1:2] == ["calibrate"]) :]]),
    }


def put_in_force(connection: Connection, rig: Rig, file: Path, program: str) -> None:
    """Have the server use the rig that `file` holds, and print that it does.

    Args:
        connection: the server.
        rig: the rig.
        file: its file, for the error message.
        program: the name of the command, which the server reports.

    Raises:
        RequestError: the server refuses it, with its reason.
        NetworkError: no server answers in time.
    """
    try:
        with connection.open() as session:
            in_force = set_rig(session, connection.arena, rig, program)
    except RequestError as error:
        raise RequestError(f"the rig in {file} is not in force; the server refuses it: {error}") from None
    except NetworkError as error:
        again = _apply_command(connection, file)
        raise NetworkError(f"the rig in {file} is not in force: {error}; then run {again}") from None
    lost = "" if in_force.saved else "; it saves no rig: start it with --rig next time"
    say(f"in force on the server at {' '.join(connection.connect)}, arena '{connection.arena}'{lost}")


def conclude(connection: Connection, rig: Rig, file: Path, program: str, *, live: bool) -> None:
    """With `live`, `put_in_force`; else print that the server was not contacted, and how to make it use the rig."""
    if live:
        put_in_force(connection, rig, file, program)
    else:
        say(f"the server was not contacted; to use the rig there: {_apply_command(connection, file)}")


def _apply_command(connection: Connection, file: Path) -> str:
    return shlex.join(["roundel", "calibrate", "apply", "--rig", str(file), *connection.options()])
