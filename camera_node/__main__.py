# SPDX-License-Identifier: BSD-3-Clause
"""The command line: `python -m camera_node` publishes one camera, `python -m camera_node NAME` is `roundel NAME`."""

import sys

from camera_node.commands import COMMANDS, PUBLISH
from camera_node.foundation.command_line import run_program
from camera_node.foundation.program import run


def main() -> None:
    """The entry point of `roundel-camera`."""
    run(lambda: execute(sys.argv[1:]))


def execute(arguments: list[str]) -> int | None:
    """Run a command line."""
    return run_program(COMMANDS, arguments, PUBLISH, "python -m camera_node")


if __name__ == "__main__":
    main()
