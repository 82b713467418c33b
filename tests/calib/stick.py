# SPDX-License-Identifier: BSD-3-Clause
"""A stick before three cameras, in the tables of programs in which people click its ends."""

from pathlib import Path

import numpy as np

from calib.commands.formats import FormatName
from calib.rig.wand_file import WandBody
from tests.calib.foreign_layouts import write_clicks
from tests.calib.synthetic import ring, see_points

LENGTH_M, SIGMA_PX = 0.5, 0.2
STICK = WandBody(markers=((0, 0, 0), (LENGTH_M, 0, 0)))


def write_stick(folder: Path, program: FormatName, table: str = "xypts.csv") -> None:
    """Write `profile.txt` and the table of 60 places of the stick."""
    arena, rng, messages = ring(3), np.random.default_rng(1), []
    for seq in range(60):
        at, along = rng.uniform([-0.6, -0.6, 0.4], [0.6, 0.6, 1.5]), rng.standard_normal(3)
        ends = np.array([at, at + LENGTH_M * along / np.linalg.norm(along)])
        for name, camera in arena.truth.cameras.items():
            uv = camera.project_world(ends) + SIGMA_PX * rng.standard_normal((2, 2))
            messages.append(see_points(name, camera, uv, SIGMA_PX, seq=seq, t_ns=0))
    write_clicks(program)(folder, arena.intrinsics, STICK, messages)
    (folder / "xypts.csv").rename(folder / table)
