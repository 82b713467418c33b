# SPDX-License-Identifier: BSD-3-Clause
"""The command line: `python -m fusion` is the live server, `python -m fusion NAME` one of the commands."""

import sys
from importlib import import_module

import tyro

from camera_node.errors import check_command, run
from camera_node.logs import set_up_logging
from fusion.commands.serve import Serve

COMMANDS = (
    "run",
    "replay",
    "record",
    "repair",
    "health",
    "doctor",
    "define",
    "robots",
    "undo",
    "ros2",
)  # modules of fusion.commands


def main() -> None:
    """The entry point of `roundel-fusion`."""
    set_up_logging()
    run(_program)


def _program() -> int:
    check_command(sys.argv[1:], COMMANDS)
    name, *arguments = sys.argv[1:] or [""]
    if name not in COMMANDS:
        return tyro.cli(Serve, prog="fusion").run()
    # imported on demand: a robot's computer has neither GTSAM nor SciPy
    command = getattr(import_module(f"fusion.commands.{name}"), name)
    return tyro.cli(command, prog=f"fusion {name}", args=arguments)


if __name__ == "__main__":
    main()
