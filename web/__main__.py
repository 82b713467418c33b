# SPDX-License-Identifier: BSD-3-Clause
"""The command line: `python -m web` is `roundel view`; with `--demo` it is `roundel demo`."""

import sys

from camera_node.foundation.program import run
from web.roundel.command import VIEW


def main() -> None:
    """The entry point of `roundel-web`."""
    run(lambda: execute(sys.argv[1:]))


def execute(arguments: list[str]) -> int | None:
    """Run a command line."""
    return VIEW.run(arguments, "roundel view")


if __name__ == "__main__":
    main()
