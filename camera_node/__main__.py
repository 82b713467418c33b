# SPDX-License-Identifier: BSD-3-Clause
"""The command line: `python -m camera_node` publishes a camera, `detect` reads images, `print` draws roundels,
`snapshot` and `settings` ask a camera that runs, `cameras` the server for all of them."""

import sys

from camera_node.commands.publish import Publish
from camera_node.foundation.command_line import run_command
from camera_node.foundation.errors import check_command
from camera_node.foundation.logs import set_up_logging
from camera_node.foundation.program import run


def main() -> None:
    """The entry point of `roundel-camera`."""
    set_up_logging()
    run(_program)


def _program() -> int | None:
    arguments = sys.argv[1:]
    check_command(arguments, ("detect", "print", "snapshot", "settings", "cameras"))
    name = arguments[0] if arguments else ""
    if name == "detect":
        from camera_node.commands.detect import Detect

        return run_command(Detect, "camera_node detect", arguments[1:])
    if name == "print":
        from camera_node.commands.print import Sheet

        return run_command(Sheet, "camera_node print", arguments[1:])
    if name in ("snapshot", "settings"):
        from camera_node.commands.adjust import ChangeSettings, SaveSnapshot

        kind = SaveSnapshot if name == "snapshot" else ChangeSettings
        return run_command(kind, f"camera_node {name}", arguments[1:])
    if name == "cameras":
        from camera_node.commands.cameras import cameras

        return run_command(cameras, "camera_node cameras", arguments[1:])
    return run_command(Publish, "camera_node", arguments)


if __name__ == "__main__":
    main()
