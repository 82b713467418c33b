# SPDX-License-Identifier: BSD-3-Clause
"""`calib plan`: range, coverage and expected precision of an arena, before anything is mounted."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from calib.commands.output import check_folder, save_image
from calib.plan.planner import Plan, PlanReport, evaluate_plan
from calib.rig.precision_plot import draw_precision
from camera_node.config import load_yaml
from camera_node.terminal import say


@dataclass(frozen=True, kw_only=True)
class PlanArena:
    """Predict what planned cameras see of an arena, and how precisely."""

    plan: Annotated[Path, tyro.conf.Positional]
    """The plan, such as configs/plan.yaml: area_m, height_m, diameter_m and cameras."""
    map: Path | None = None
    """Write a PNG of the expected errors."""

    def execute(self) -> None:
        """Print the report; write the map only."""
        if self.map is not None:
            check_folder(self.map)
        plan = load_yaml(self.plan, Plan)
        report = evaluate_plan(plan)
        for line in describe(plan, report):
            say(line)
        if self.map is not None:
            cameras = {name: camera.camera() for name, camera in plan.cameras.items()}
            save_image(self.map, draw_precision(report.precision, cameras))
            say(f"wrote {self.map}")


def describe(plan: Plan, report: PlanReport) -> list[str]:
    """The report, line by line."""
    lines = [
        f"{name}: level roundels of {plan.diameter_m:g} m from {reach.v_min:.2f} to {reach.v_max:.2f} m along its axis "
        f"({plan.min_diameter_px:g} px), {reach.v_y:.2f} x {reach.v_z:.2f} m there; sees {reach.share:.0%} of the area"
        for name, reach in report.ranges.items()
    ]
    precision = report.precision
    lines += precision.lines()
    lines.append(
        f"two cameras or more see {precision.covered:.0%} of the area, one {np.mean(precision.views == 1):.0%}, none "
        f"{np.mean(precision.views == 0):.0%}; expected error {precision.typical_mm:.2f} mm in the median, "
        f"{precision.worst_mm:.2f} mm at the 95 % quantile"
    )
    if precision.covered < 1:
        lines.append("to cover more: mount cameras higher, add a camera, or print larger roundels")
    return lines
