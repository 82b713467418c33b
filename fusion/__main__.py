# SPDX-License-Identifier: BSD-3-Clause
"""The command line: `python -m fusion` is the live server, `python -m fusion NAME` one of the commands."""

import sys
from importlib import import_module

import tyro

from camera_node.errors import check_command, run
from camera_node.logs import set_up_logging
from fusion.commands.serve import Serve

COMMANDS = {  # and their modules in fusion.commands
    "run": "run",
    "replay": "replay",
    "record": "record",
    "repair": "repair",
    "health": "health",
    "doctor": "doctor",
    "define": "define",
    "robots": "robots",
    "undo": "undo",
    "redo": "undo",
    "ros2": "ros2",
    "vrpn": "vrpn",
}


def main() -> None:
    """The entry point of `roundel-fusion`."""
    set_up_logging()
    run(_program)


def _program() -> int:
    check_command(sys.argv[1:], tuple(COMMANDS))
    name, *arguments = sys.argv[1:] or [""]
    if name not in COMMANDS:
        return tyro.cli(Serve, prog="fusion").run()
    # imported on demand: a robot's computer has neither GTSAM nor SciPy
    command = getattr(import_module(f"fusion.commands.{COMMANDS[name]}"), name)
    return tyro.cli(command, prog=f"fusion {name}", args=arguments)


if __name__ == "__main__":
    main()
