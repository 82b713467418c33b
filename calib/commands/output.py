# SPDX-License-Identifier: BSD-3-Clause
"""What all subcommands do with their result: write it, say where, and how it was made."""

import os
import shlex
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from calib.intrinsics.residual_plot import draw_residuals, save_map
from calib.rig.rig import Rig, save_rig
from calib.wand.quality.grade import RigQuality
from calib.wand.result import WandCalibration
from camera_node import terminal
from camera_node.errors import ConfigError


def check_folder(out: Path) -> None:
    """Raise ConfigError, before any work is done, where `out` can't be written."""
    if not out.parent.is_dir():
        raise ConfigError(f"{out.parent} is no folder; --out can't be written there")
    if not os.access(out.parent, os.W_OK):
        raise ConfigError(f"{out.parent} can't be written to; give --out a file in another folder")
    if out.is_dir():
        raise ConfigError(f"{out} is a folder; give --out a file such as {out / 'rig.yaml'}")


def write_rig(rig: Rig, out: Path, console: Console) -> None:
    """Write the rig and say so."""
    kept = save_rig(rig, out)
    say(console, f"wrote {out}" + (f"; the one before is kept as {kept.name}" if kept else ""))


def save_maps(folder: Path, result: WandCalibration, trust: RigQuality, console: Console) -> None:
    """A picture of each camera's residuals, with where to wave next, and one of the expected errors."""
    seen, adjusted = result.observations, result.adjusted
    for k, camera in enumerate(trust.cameras):
        mine, lens = adjusted.used & (seen.camera == k), result.rig.cameras[camera.name]
        picture = draw_residuals(camera.name, lens, seen.uv[mine], adjusted.residuals[mine], camera.missing)
        save_map(folder / f"{camera.name}.png", picture)
    if trust.expected is not None:
        save_map(folder / "expected.png", trust.expected.draw(result.rig.placed()))
    say(console, f"wrote pictures of residuals and expected errors into {folder}")


def say(console: Console, text: str) -> None:
    """One line as it stands."""
    terminal.say(text, console)


def provenance() -> dict[str, Any]:
    """Date and command, for the `calibration` map of a rig."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": shlex.join(["python", "-m", "calib", *sys.argv[1:]]),
    }
