# SPDX-License-Identifier: BSD-3-Clause
"""`roundel sample`: the data of a small arena, to try every offline command with."""

import shlex
import shutil
from pathlib import Path

from camera_node.foundation.config import example_file, new_path
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say

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
    source = example_file("sample")
    with new_path(folder) as part:
        part.mkdir()
        for path in sorted(source.rglob("*")):  # shutil.copytree collects errors to one without a number
            target = part / path.relative_to(source)
            target.mkdir() if path.is_dir() else shutil.copyfile(path, target)
    say(f"wrote {folder}: four cameras, three robots. Try, for example:")
    for command in NEXT:
        say(f"  {command.format(shlex.quote(str(folder)))}")
    say(f"The notebook {folder}/notebook.ipynb loads, draws and compares.")
    return 0
