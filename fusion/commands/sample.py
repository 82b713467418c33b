# SPDX-License-Identifier: BSD-3-Clause
"""`roundel sample`: the data of a small arena, to try every offline command with."""

import shlex
import shutil
from pathlib import Path

from camera_node.foundation.config import example_file
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say
from fusion.export.pose_formats import new_path

NEXT = (
    "roundel detect {0}/frames/north --rig {0}/rig.yaml --name north --diameter 0.12",
    "roundel calibrate wand --wand {0}/wand.yaml --rig {0}/lenses.yaml --recording {0}/wand.mcap --out {0}/new.yaml",
    "roundel run --frames {0}/frames --rig {0}/rig.yaml --robots {0}/robots.yaml --out {0}/poses.csv",
    "roundel replay {0}/recording.mcap --out {0}/poses.csv",
    "roundel plot {0}/recording.mcap",
    "roundel view --replay {0}/recording.mcap",
)


def sample(folder: Path = Path("sample"), /) -> int:
    """Write the frames, calibration, robots, recordings and a notebook of a small simulated arena.

    Args:
        folder: where to; it must not exist.
    """
    if folder.exists():
        raise ConfigError(f"{folder} exists; give the name of a new folder, such as roundel sample {folder}2")
    with new_path(folder) as part:
        shutil.copytree(example_file("sample"), part)
    say(f"wrote {folder}: four cameras, three robots. Try, for example:")
    for command in NEXT:
        say(f"  {command.format(shlex.quote(str(folder)))}")
    say(f"The notebook {folder}/notebook.ipynb loads, draws and compares.")
    return 0
