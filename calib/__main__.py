# SPDX-License-Identifier: BSD-3-Clause
"""`python -m calib`: lenses, where cameras stand, and the world they stand in."""

import sys
from typing import Annotated

import tyro

from calib.commands.check import Check
from calib.commands.intrinsics import Intrinsics
from calib.commands.plan import PlanArena
from calib.commands.undo import Undo
from calib.commands.wand import Wand
from calib.commands.world import World
from camera_node.errors import run
from camera_node.terminal import console

Command = (
    Annotated[Intrinsics, tyro.conf.subcommand("intrinsics")]
    | Annotated[Wand, tyro.conf.subcommand("wand")]
    | Annotated[World, tyro.conf.subcommand("world")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[PlanArena, tyro.conf.subcommand("plan")]
    | Annotated[Undo, tyro.conf.subcommand("undo")]
)


def main() -> None:
    """The program `roundel-calib`."""
    run(lambda: execute(sys.argv[1:]))


def execute(arguments: list[str]) -> None:
    """Do what the command line asks; `--undo` first is the subcommand `undo`."""
    if arguments[:1] == ["--undo"]:
        arguments = ["undo", *arguments[1:]]
    tyro.cli(Command, prog="calib", description=__doc__, args=arguments).execute(console())


if __name__ == "__main__":
    main()
