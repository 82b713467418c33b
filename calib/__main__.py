# SPDX-License-Identifier: BSD-3-Clause
"""The command line: `python -m calib NAME` is `roundel calibrate NAME`."""

import sys

from calib.commands import CALIBRATE
from camera_node.foundation.program import run


def main() -> None:
    """The entry point of `roundel-calib`."""
    run(lambda: execute(sys.argv[1:]))


def execute(arguments: list[str]) -> int | None:
    """Run a command line; `--undo` as the first argument stands for the command `undo`."""
    if arguments[:1] == ["--undo"]:
        arguments = ["undo", *arguments[1:]]
    return CALIBRATE.run(arguments, "roundel calibrate")


if __name__ == "__main__":
    main()
