# SPDX-License-Identifier: BSD-3-Clause
"""`python -m calib`: calibrates lenses, camera poses and the world frame."""

import logging
import os
import sys
from collections.abc import Sequence
from typing import Annotated, get_args

# Before NumPy is loaded, as in fusion.__main__.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tyro

from calib.commands.apply import Apply
from calib.commands.check import Check
from calib.commands.formats import ExportRig, ImportData
from calib.commands.intrinsics import Intrinsics
from calib.commands.plan import PlanArena
from calib.commands.undo import Redo, Undo
from calib.commands.wand import Wand
from calib.commands.world import World
from camera_node.foundation.command_line import parse
from camera_node.foundation.errors import check_command
from camera_node.foundation.logs import set_up_logging
from camera_node.foundation.program import run

Command = (
    Annotated[Intrinsics, tyro.conf.subcommand("intrinsics")]
    | Annotated[Wand, tyro.conf.subcommand("wand")]
    | Annotated[World, tyro.conf.subcommand("world")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[PlanArena, tyro.conf.subcommand("plan")]
    | Annotated[ImportData, tyro.conf.subcommand("import")]
    | Annotated[ExportRig, tyro.conf.subcommand("export")]
    | Annotated[Undo, tyro.conf.subcommand("undo")]
    | Annotated[Redo, tyro.conf.subcommand("redo")]
    | Annotated[Apply, tyro.conf.subcommand("apply")]
)
COMMANDS = tuple(get_args(command)[1].name for command in get_args(Command))


def main() -> None:
    """The program `roundel-calib`."""
    set_up_logging(logging.WARNING)
    run(lambda: execute(sys.argv[1:]))


def execute(arguments: list[str], prog: str = "calib", examples: Sequence[str] = ()) -> None:
    """Run a command line; `--undo` as the first argument stands for the subcommand `undo`.

    Args:
        arguments: the command line without the program.
        prog: the program's name in its help and in errors.
        examples: complete command lines that `--help` shows.
    """
    if arguments[:1] == ["--undo"]:
        arguments = ["undo", *arguments[1:]]
    check_command(arguments, COMMANDS)
    parse(Command, prog, arguments, examples).execute()


if __name__ == "__main__":
    main()
