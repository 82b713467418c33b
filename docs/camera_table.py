# SPDX-License-Identifier: BSD-3-Clause
"""Prints the table of cameras in docs/cameras.md: `python docs/camera_table.py`.

Four cameras of each kind hang as in configs/plan.yaml. The planner predicts their errors for robots at rest and at
0.5 m/s, and the range within which a level roundel of 9 cm is found.
"""

from pathlib import Path

import msgspec
import numpy as np

from calib.plan.camera_kind import CameraKind, PlannedCamera
from calib.plan.description import Plan
from calib.plan.planner import PlannedArena, PlanReport, evaluate
from camera_node.foundation.config import load_yaml

KINDS = {
    "webcam, 1080p, 30 Hz": CameraKind(width=1920, height=1080, fov_deg=75.0, fps=30.0, shutter="rolling"),
    "Raspberry Pi Camera Module 3": CameraKind(model="rpi-3"),
    "Raspberry Pi Global Shutter, lens of 6 mm": CameraKind(model="rpi-gs"),
    "OV9281 board, 1 MP, global shutter": CameraKind(model="ov9281"),
    "AR0234 board, 2.3 MP, global shutter": CameraKind(model="ar0234"),
    "industrial camera, IMX392, 2.3 MP": CameraKind(model="imx392"),
}


def main() -> None:
    """Print the table."""
    plan = load_yaml(Path(__file__).parent.parent / "configs" / "plan.yaml", Plan)
    print(
        "| four cameras of this kind | covered | error at rest | at 0.5 m/s | range |\n|---|---|---|---|---|"
    )
    for name, kind in KINDS.items():
        rest, moving = (predict(plan, kind, speed_m_s) for speed_m_s in (0.0, 0.5))
        reach_m = np.mean([reach.space.v_max for reach in rest.reach.values()])
        covered = rest.covered.mean()
        print(
            f"| {name} | {covered:.0%} | {rest.median_mm:.1f} mm | {moving.median_mm:.1f} mm | {reach_m:.0f} m |"
        )


def predict(plan: Plan, kind: CameraKind, speed_m_s: float) -> PlanReport:
    """The plan with other cameras at the same places, and robots of this speed."""
    cameras = {
        name: PlannedCamera(
            **msgspec.structs.asdict(kind), position_m=place.position_m, look_at_m=place.look_at_m
        )
        for name, place in plan.cameras.items()
    }
    robots = msgspec.structs.replace(plan.robots, speed_m_s=speed_m_s)
    return evaluate(PlannedArena.of(msgspec.structs.replace(plan, cameras=cameras, robots=robots)))


if __name__ == "__main__":
    main()
