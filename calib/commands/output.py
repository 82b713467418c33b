# SPDX-License-Identifier: BSD-3-Clause
"""Writes the results of subcommands: rigs with their provenance, and images."""

import os
import shlex
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.intrinsics.residual_plot import draw_residuals
from calib.rig.precision_plot import draw_precision
from calib.rig.rig import Rig, save_rig
from calib.wand.quality.grade import RigQuality
from calib.wand.result import WandCalibration
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say


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
        raise ConfigError(f"{path} can't be written: {error.strerror}") from None


def save_maps(folder: Path, result: WandCalibration, quality: RigQuality) -> None:
    """Write an image of each camera's residuals, with the area to wave in next, and one of the expected errors."""
    observations, adjusted = result.observations, result.adjusted
    for k, camera in enumerate(quality.cameras):
        rows, lens = adjusted.used & (observations.camera == k), result.rig.cameras[camera.name]
        image = draw_residuals(
            camera.name, lens, observations.uv[rows], adjusted.residuals[rows], camera.missing
        )
        save_image(folder / f"{camera.name}.png", image)
    if quality.expected is not None:
        save_image(folder / "expected.png", draw_precision(quality.expected, result.rig.placed()))
    say(f"wrote images of residuals and expected errors to {folder}")


def provenance() -> dict[str, Any]:
    """Date and command, for the `calibration` map of a rig."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": shlex.join(["python", "-m", "calib", *sys.argv[1:]]),
    }
