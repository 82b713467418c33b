# SPDX-License-Identifier: BSD-3-Clause
"""The command line: `python -m fusion` is `roundel server`, `python -m fusion NAME` is `roundel NAME`."""

import sys

from camera_node.foundation.command_line import run_program
from camera_node.foundation.program import run
from fusion.commands import COMMANDS, SERVER


def main() -> None:
    """The entry point of `roundel-fusion`."""
    run(lambda: execute(sys.argv[1:]))


def execute(arguments: list[str]) -> int | None:
    """Run a command line."""
    return run_program(COMMANDS, arguments, SERVER, "roundel server")


if __name__ == "__main__":
    main()
