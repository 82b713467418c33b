# SPDX-License-Identifier: BSD-3-Clause
"""The command line: `python -m fusion` is the live server, `python -m fusion NAME` one of the commands."""

import os
import sys
from importlib import import_module
from typing import Any

# Before NumPy is loaded: threads of a BLAS wait for each other longer than the products of small matrices take.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from camera_node.foundation.command_line import run_command
from camera_node.foundation.errors import check_command
from camera_node.foundation.logs import set_up_logging
from camera_node.foundation.program import run
from fusion.commands.serve import Serve

COMMANDS = {  # and their modules in fusion.commands
    "run": "run",
    "replay": "replay",
    "record": "record",
    "recordings": "recordings",
    "repair": "repair",
    "trim": "trim",
    "health": "health",
    "doctor": "doctor",
    "define": "define",
    "robots": "robots",
    "history": "history",
    "undo": "history",
    "redo": "history",
    "export": "export",
    "ros2": "bridges.ros2",
    "vrpn": "bridges.vrpn",
    "mavlink": "bridges.mavlink",
    "foxglove": "bridges.foxglove",
}


def main() -> None:
    """The entry point of `roundel-fusion`."""
    set_up_logging()
    run(_program)


def _program() -> int:
    check_command(sys.argv[1:], tuple(COMMANDS))
    name, *arguments = sys.argv[1:] or [""]
    if name not in COMMANDS:
        return run_command(Serve, "fusion", sys.argv[1:]) or 0
    return run_command(load_command(name), f"fusion {name}", arguments) or 0


def load_command(name: str) -> Any:
    """Import the function of one of `COMMANDS`: a robot's computer has neither GTSAM nor SciPy."""
    return getattr(import_module(f"fusion.commands.{COMMANDS[name]}"), name)


if __name__ == "__main__":
    main()
