# SPDX-License-Identifier: BSD-3-Clause
"""The command `roundel`: joins the commands of all programs, and runs one of them."""

import logging
import os
import sys

from calib.commands import COMMANDS as CALIBRATION
from camera_node.commands import COMMANDS as CAMERAS
from camera_node.foundation.command_line import Command, list_commands, run_one_of
from camera_node.foundation.program import run
from fusion.commands import COMMANDS as FUSION

UP = Command(
    "up",
    "run an arena: the server, its page and the cameras of this machine",
    "web.roundel.up:RunArena",
    (
        "roundel up",
        "roundel up lab --source 0 /dev/video2",
        "roundel up lab --headless --source recording/north",
    ),
    "Arena",
)
DEMO = Command(
    "demo",
    "calibrate and track a simulated arena, and show it",
    "web.roundel.demo:RunDemo",
    ("roundel demo", "roundel demo --headless --seconds 20", "roundel demo --relative"),
    "Arena",
    logging.WARNING,
)
VIEW = Command(
    "view",
    "show an arena or a recording in the browser",
    "web.roundel.serve_page:ViewArena",
    ("roundel view --connect tcp/localhost:7447", "roundel view --replay recording.mcap"),
    "Arena",
    logging.WARNING,
)
COMMANDS = (UP, DEMO, VIEW, *CAMERAS, *CALIBRATION, *FUSION)


def main() -> None:
    """The entry point of `roundel`."""
    # A child that is started as `python -m` in a checkout would import the sources there instead of the package.
    os.environ.setdefault("PYTHONSAFEPATH", "1")
    run(lambda: execute(*sys.argv[1:]))


def execute(*arguments: str) -> int | None:
    """Run a command line; return its exit code."""
    if arguments[:1] == ("help",):
        arguments = (*arguments[1:], "--help")
    if arguments in (("--version",), ("version",)):
        from importlib.metadata import version

        print(f"roundel {version('roundel')}")
        return 0
    return run_one_of(COMMANDS, arguments or ("--help",), "roundel", overview)


def overview() -> str:
    """The list of commands."""
    text = list_commands(COMMANDS, "roundel", "Locates printed roundels with cameras.")
    return f"{text}\nroundel --version prints the version."


if __name__ == "__main__":
    main()
