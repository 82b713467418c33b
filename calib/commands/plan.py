# SPDX-License-Identifier: BSD-3-Clause
"""`calib plan`: coverage, range and expected precision of an arena, before anything is mounted."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from calib.commands.output import check_folder, say
from calib.intrinsics.residual_plot import save_map
from calib.plan.planner import Forecast, Plan, foresee
from camera_node.config import load_yaml


@dataclass(frozen=True, kw_only=True)
class PlanArena:
    """Foretell what planned cameras would see of an arena, and how precisely."""

    plan: Annotated[Path, tyro.conf.Positional]
    """The plan, such as configs/plan.yaml: area_m, height_m, diameter_m and cameras."""
    map: Path | None = None
    """A PNG of the expected errors."""

    def execute(self, console: Console) -> None:
        """Nothing but the map is written."""
        if self.map is not None:
            check_folder(self.map)
        plan = load_yaml(self.plan, Plan)
        forecast = foresee(plan)
        for line in describe(plan, forecast):
            say(console, line)
        if self.map is not None:
            cameras = {name: camera.camera() for name, camera in plan.cameras.items()}
            save_map(self.map, forecast.expected.draw(cameras))
            say(console, f"wrote {self.map}")


def describe(plan: Plan, forecast: Forecast) -> list[str]:
    """What a person wants to know, line by line."""
    lines = [
        f"{name}: level roundels of {plan.diameter_m:g} m from {told.v_min:.2f} to {told.v_max:.2f} m along its axis "
        f"({plan.min_diameter_px:g} px), {told.v_y:.2f} x {told.v_z:.2f} m there; sees {told.share:.0%} of the area"
        for name, told in forecast.ranges.items()
    ]
    expected = forecast.expected
    lines += expected.lines()
    lines.append(
        f"two cameras or more see {expected.covered:.0%} of the area, one {np.mean(expected.views == 1):.0%}, none "
        f"{np.mean(expected.views == 0):.0%}; expected error {expected.typical_mm:.2f} mm in the median, "
        f"{expected.worst_mm:.2f} mm for 95 %"
    )
    if expected.covered < 1:
        lines.append(
            "to cover more: mount higher, add a camera, or print larger roundels where they are too far"
        )
    return lines
