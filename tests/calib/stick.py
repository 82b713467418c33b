# SPDX-License-Identifier: BSD-3-Clause
"""A stick before three cameras, in the tables of programs in which people click its ends."""

from pathlib import Path

import numpy as np

from calib.commands.formats import FORMATS, FormatName
from tests.calib.synthetic import ring

LENGTH_M = 0.5


def write_stick(folder: Path, name: FormatName, table: str = "xypts.csv") -> None:
    """Write `profile.txt` and the table: 60 places, 0.2 px of noise, pixels counted from 1, NaN where out of view."""
    truth, rng = ring(3).truth, np.random.default_rng(1)
    rows = []
    for _ in range(60):
        at, along = rng.uniform([-0.6, -0.6, 0.4], [0.6, 0.6, 1.5]), rng.standard_normal(3)
        ends = np.array([at, at + LENGTH_M * along / np.linalg.norm(along)])
        uv = np.array(
            [c.project_world(ends) + 0.2 * rng.standard_normal((2, 2)) for c in truth.cameras.values()]
        )
        seen = np.array([c.sees(uv[k]) for k, c in enumerate(truth.cameras.values())])
        written = uv + 1
        if name == "argus":  # rows from the bottom
            heights = np.array([c.height for c in truth.cameras.values()])
            written[..., 1] = heights[:, None] - uv[..., 1]
        rows.append(np.where(seen[..., None], written, np.nan).swapaxes(0, 1).ravel())
    header = [f"pt{m}_cam{c}_{x}" for m in (1, 2) for c in (1, 2, 3) for x in "XY"]
    np.savetxt(folder / table, np.array(rows), delimiter=",", header=",".join(header), comments="")
    FORMATS[name].write(ring(3).intrinsics, folder, FORMATS[name].origin)
