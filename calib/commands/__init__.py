# SPDX-License-Identifier: BSD-3-Clause
"""The commands that calibrate and plan, one module each: its options, and what it does with them."""

import logging

from camera_node.foundation.command_line import Command

PLAN = Command(
    "plan",
    "predict coverage and precision, and where to mount cameras",
    "calib.commands.plan:PlanArena",
    (
        "roundel plan configs/plan.yaml --report plan.html",
        "roundel plan configs/plan.yaml --suggest 6 --out suggested.yaml",
        "roundel plan --rig rig.yaml --json",
    ),
    "Calibration",
    logging.WARNING,
)


def _calibration(name: str, summary: str, target: str, *examples: str) -> Command:
    return Command(name, summary, f"calib.commands.{target}", examples, "Calibration", logging.WARNING)


CALIBRATE = Command(
    "calibrate",
    "calibrate lenses, camera poses and the floor",
    (
        _calibration(
            "intrinsics",
            "calibrate lenses from images of a board",
            "calibrate_intrinsics:Intrinsics",
            "roundel calibrate intrinsics --frames board --board charuco:5x4:0.054 --out rig.yaml",
        ),
        _calibration(
            "wand",
            "calibrate camera poses from a wand that is waved in front of the cameras",
            "calibrate_wand:Wand",
            "roundel calibrate wand --live --wand wand.yaml --rig rig.yaml --out rig.yaml",
        ),
        _calibration(
            "world",
            "fix the ground plane, the origin and the axes",
            "calibrate_world:World",
            "roundel calibrate world --rig rig.yaml --frame l.yaml --live --out rig.yaml",
        ),
        _calibration(
            "check",
            "judge a rig by a wand recording",
            "check:Check",
            "roundel calibrate check --rig rig.yaml --recording rig.wave.mcap",
        ),
        PLAN,
        _calibration(
            "import",
            "convert cameras and points of another program",
            "formats:ImportData",
            "roundel calibrate import --format opencv --out imported camera.yml",
        ),
        _calibration(
            "export",
            "convert a rig to the files of another program",
            "formats:ExportRig",
            "roundel calibrate export --format kalibr --rig rig.yaml --out exported",
        ),
        _calibration(
            "undo",
            "restore the rig from before the last calibration",
            "rig_versions:Undo",
            "roundel calibrate undo --rig rig.yaml",
        ),
        _calibration(
            "redo",
            "restore the rig that was undone last",
            "rig_versions:Redo",
            "roundel calibrate redo --rig rig.yaml",
        ),
        _calibration(
            "apply",
            "have the running server use a rig",
            "rig_versions:Apply",
            "roundel calibrate apply --rig rig.yaml",
        ),
    ),
    (
        "roundel calibrate intrinsics --frames board --board charuco:5x4:0.054 --out rig.yaml",
        "roundel calibrate wand --live --wand wand.yaml --rig rig.yaml --out rig.yaml",
        "roundel calibrate undo --rig rig.yaml",
    ),
    "Calibration",
)
COMMANDS = (CALIBRATE, PLAN)
