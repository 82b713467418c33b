# SPDX-License-Identifier: BSD-3-Clause
"""Prints the tables of docs/accuracy.md: `python docs/accuracy_table.py`.

The planner predicts the errors of configs/plan.yaml (four cameras of 1080p and 75 degrees, 3 m above a floor of 4 m by
3 m, robots at rest with three roundels of 9 cm), with one thing changed at a time.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import msgspec

from calib.plan.camera_kind import PlannedCamera
from calib.plan.description import Plan
from calib.plan.planner import PlannedArena, evaluate
from camera_node.foundation.config import load_yaml

replace = msgspec.structs.replace
Change = Callable[[Plan], Plan]


def main() -> None:
    """Print one row for each change."""
    plan = robots(load_yaml(Path(__file__).parent.parent / "configs" / "plan.yaml", Plan), speed_m_s=0.0)
    print("| changed | seen by two cameras | median error | 90 % are below |\n|---|---|---|---|")
    for name, change in changes():
        report = evaluate(PlannedArena.of(change(plan)))
        errors = " | ".join(f"{report.quantile_mm(share):.2f} mm" for share in (0.5, 0.9))
        print(f"| {name} | {report.covered.mean():.0%} | {errors} |", flush=True)


def changes() -> Iterator[tuple[str, Change]]:
    """What is changed, and how."""
    yield "the arena of `configs/plan.yaml`", lambda plan: plan
    for n in (2, 3, 6, 8):
        yield f"{n} cameras", partial(ring, n=n)
    for factor in (2, 3):
        yield f"{factor} times as large, cameras {3 * factor} m high", partial(enlarge, factor=factor)
    for diameter_m in (0.05, 0.15):
        yield f"roundels of {100 * diameter_m:.0f} cm", partial(robots, diameter_m=diameter_m)
    yield "one roundel in place of three", partial(robots, markers=((0.0, 0.0, 0.0),))
    for fov_deg in (55.0, 100.0):
        yield f"lenses of {fov_deg:.0f} degrees", partial(cameras, fov_deg=fov_deg)
    yield "640 x 480 pixels", partial(cameras, width=640, height=480)
    for sigma_px in (0.03, 0.3):
        yield f"calibration, print and light: {sigma_px} px", partial(image, sigma_px=sigma_px)
    yield "half the contrast, twice the noise", partial(image, contrast=75.0, noise=6.0)
    for speed_m_s in (0.5, 2.0):
        yield f"robots at {speed_m_s:g} m/s", partial(robots, speed_m_s=speed_m_s)
    yield "robots at 2 m/s, rolling shutters", lambda plan: cameras(fast(plan), shutter="rolling")
    yield "robots at 2 m/s, time stamps off by 2 ms", lambda plan: cameras(fast(plan), stamp_sigma_ms=2.0)


def robots(plan: Plan, **values: object) -> Plan:
    """The plan with other values of its robots."""
    return replace(plan, robots=replace(plan.robots, **values))


def fast(plan: Plan) -> Plan:
    """The plan with robots at 2 m/s."""
    return robots(plan, speed_m_s=2.0)


def image(plan: Plan, **values: object) -> Plan:
    """The plan with another quality of the images."""
    return replace(plan, image=replace(plan.image, **values))


def cameras(plan: Plan, **values: object) -> Plan:
    """The plan with other values of all cameras."""
    return replace(plan, cameras={name: replace(camera, **values) for name, camera in plan.cameras.items()})


def ring(plan: Plan, n: int) -> Plan:
    """The plan with n cameras around the floor, as high as before."""
    kind, placed = next(iter(plan.cameras.values())), {}
    for k in range(n):
        x, y = 3.0 * math.sin(2 * math.pi * k / n), 2.5 * math.cos(2 * math.pi * k / n)
        position, target = (x, y, 3.0), (-0.07 * x, -0.07 * y, 0.0)
        placed[f"cam{k}"] = replace(kind, position_m=position, look_at_m=target)
    return replace(plan, cameras=placed)


def enlarge(plan: Plan, factor: float) -> Plan:
    """The plan with all lengths but those of the robots multiplied."""

    def place(camera: PlannedCamera) -> PlannedCamera:
        position, target = (
            tuple(factor * x for x in point) for point in (camera.position_m, camera.look_at_m)
        )
        return replace(camera, position_m=position, look_at_m=target)

    return replace(
        plan,
        area_m=tuple(factor * x for x in plan.area_m),
        room_m=tuple(factor * x for x in plan.room_m or plan.area_m),
        ceiling_m=factor * plan.ceiling_m,
        cameras={name: place(camera) for name, camera in plan.cameras.items()},
    )


if __name__ == "__main__":
    main()
