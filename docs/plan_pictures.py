# SPDX-License-Identifier: BSD-3-Clause
"""Draws the pictures of docs/planning.md: `python docs/plan_pictures.py`; takes a minute.

They are the figures of `roundel plan --report` for eight suggested cameras in a room of 6 x 6 x 3 m.
"""

from pathlib import Path

from calib.plan.camera_kind import CameraKind
from calib.plan.description import Plan, PlannedRobots, Requirement
from calib.plan.placement import PlacementProblem, suggest_placement
from calib.plan.plan_report import draw_coverage, draw_distribution, draw_errors
from calib.plan.planner import PlannedArena, evaluate
from camera_node.foundation.terminal import progress_bar

KIND = CameraKind(model="ov9281")
PLAN = Plan(
    area_m=(-3.0, -3.0, 3.0, 3.0),
    ceiling_m=3.0,
    robots=PlannedRobots(diameter_m=0.12, heights_m=(0.1, 1.5)),
    required=Requirement(error_mm=1.0, share=0.95),
)
PICTURES = {"errors": draw_errors, "coverage": draw_coverage, "distribution": draw_distribution}


def main() -> None:
    """Write the pictures beside this file."""
    with progress_bar("placing 8 cameras") as progress:
        places = suggest_placement(PlacementProblem(PLAN, KIND), 8, progress)
    report = evaluate(PlannedArena.of_cameras(PLAN, places.cameras(KIND), KIND))
    for name, draw in PICTURES.items():
        draw(report).savefig(Path(__file__).parent / f"plan_{name}.png", dpi=80)


if __name__ == "__main__":
    main()
