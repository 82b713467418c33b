# SPDX-License-Identifier: BSD-3-Clause
"""The command `roundel`: names the programs' commands and runs one of them.

A command's modules are imported when it runs: a camera's computer has neither GTSAM nor Viser, and the list of
commands appears at once. `COMMANDS` is the list in the order of the work; the other commands of `fusion` follow it.
"""

import logging
import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import requires, version

# Before NumPy is loaded, as in fusion.__main__: `roundel server` runs in this process.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from camera_node.foundation.command_line import parse, run_command
from camera_node.foundation.errors import ConfigError, check_command
from camera_node.foundation.logs import set_up_logging
from camera_node.foundation.program import run

Runner = Callable[[str, Sequence[str], Sequence[str]], int | None]


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes:
        summary: what it does, in one line.
        run: executes it; called with its full name, its arguments and its examples.
        examples: complete command lines.
        log_level: of its log on stderr.
    """

    summary: str
    run: Runner
    examples: tuple[str, ...]
    log_level: int = logging.INFO


def _class_or_function(place: str) -> Runner:
    """Runs a dataclass or function, given as `module:name`."""

    def execute(prog: str, arguments: Sequence[str], examples: Sequence[str]) -> int | None:
        module, name = place.split(":")
        return run_command(getattr(import_module(module), name), prog, arguments, examples)

    return execute


def _calibrate(prog: str, arguments: Sequence[str], examples: Sequence[str]) -> None:
    from calib.__main__ import execute

    execute(list(arguments), prog, examples)


def _plan(prog: str, arguments: Sequence[str], examples: Sequence[str]) -> None:
    from calib.commands.plan import PlanArena

    parse(PlanArena, prog, arguments, examples).execute()


def _view(prog: str, arguments: Sequence[str], examples: Sequence[str]) -> int:
    from web.__main__ import program

    return program(arguments, prog, examples)


COMMANDS = {
    "up": Command(
        "run an arena: the server, its page and the cameras of this machine",
        _class_or_function("web.roundel.up:RunArena"),
        (
            "roundel up",
            "roundel up lab --source 0 /dev/video2",
            "roundel up lab --headless --source recording/north",
        ),
    ),
    "demo": Command(
        "calibrate and track a simulated arena, and show it",
        _class_or_function("web.roundel.demo:RunDemo"),
        ("roundel demo", "roundel demo --headless --seconds 20", "roundel demo --relative"),
        logging.WARNING,
    ),
    "camera": Command(
        "add the cameras of this machine to an arena",
        _class_or_function("camera_node.commands.camera:JoinArena"),
        (
            "roundel camera",
            "roundel camera --source 0 --connect tcp/server:7447",
            "roundel camera --source recording/north recording/east",
            "roundel camera --source 0 --name scout --rig rig.yaml --diameter 0.09 --listen tcp/127.0.0.1:7447",
        ),
    ),
    "cameras": Command(
        "list, rename and forget cameras; show what one refuses, and why",
        _class_or_function("camera_node.commands.cameras:cameras"),
        (
            "roundel cameras list",
            "roundel cameras rename camera-1 north",
            "roundel cameras why north refused.jpg",
        ),
    ),
    "settings": Command(
        "show and change exposure, gain and mask of a running camera",
        _class_or_function("camera_node.commands.adjust:ChangeSettings"),
        (
            "roundel settings north",
            "roundel settings north --exposure-us 4000 --gain 2",
            "roundel settings north --mask-detected",
        ),
        logging.WARNING,
    ),
    "snapshot": Command(
        "save the image of a running camera",
        _class_or_function("camera_node.commands.adjust:SaveSnapshot"),
        ("roundel snapshot north north.jpg --draw",),
        logging.WARNING,
    ),
    "detect": Command(
        "detect roundels in pictures",
        _class_or_function("camera_node.commands.detect:Detect"),
        ("roundel detect picture.png --draw seen.png", "roundel detect *.png --json"),
    ),
    "print": Command(
        "print roundels, wands, boards, L-frames and robots at true scale",
        _class_or_function("camera_node.commands.print:Sheet"),
        (
            "roundel print roundels",
            "roundel print roundels sheet.svg --diameter 0.12 --paper letter",
            "roundel print wand",
            "roundel print board board.pdf --columns 5 --rows 7 --square 0.035",
            "roundel print robot rover.pdf --file robots.yaml --name rover",
        ),
    ),
    "calibrate": Command(
        "calibrate lenses, camera poses and the floor",
        _calibrate,
        (
            "roundel calibrate intrinsics --frames board --board charuco:5x4:0.054 --out rig.yaml",
            "roundel calibrate wand --live --wand wand.yaml --rig rig.yaml --out rig.yaml",
            "roundel calibrate undo --rig rig.yaml",
        ),
        logging.WARNING,
    ),
    "plan": Command(
        "predict coverage and precision, and where to mount cameras",
        _plan,
        (
            "roundel plan configs/plan.yaml --report plan.html",
            "roundel plan configs/plan.yaml --suggest 6 --out suggested.yaml",
            "roundel plan --rig rig.yaml --json",
        ),
        logging.WARNING,
    ),
    "server": Command(
        "fuse what the cameras publish into poses",
        _class_or_function("fusion.commands.serve:Serve"),
        ("roundel server --config arena.yaml", "roundel server --listen tcp/0.0.0.0:7447 --rig rig.yaml"),
    ),
    "view": Command(
        "show an arena or a recording in the browser",
        _view,
        ("roundel view --connect tcp/localhost:7447", "roundel view --replay recording.mcap"),
        logging.WARNING,
    ),
    "record": Command(
        "record a running arena",
        _class_or_function("fusion.commands.record:record"),
        ("roundel record monday.mcap --seconds 60",),
    ),
    "replay": Command(
        "process a recording with the live code",
        _class_or_function("fusion.commands.replay:replay"),
        ("roundel replay monday.mcap --out poses.csv",),
    ),
    "robots": Command(
        "list, rename, remove and save the robots of the running server",
        _class_or_function("fusion.commands.robots:robots"),
        ("roundel robots list", "roundel robots rename robot-1 rover", "roundel robots save robots.yaml"),
    ),
    "simulate": Command(
        "render a simulated recording into a folder",
        _class_or_function("camera_node.simulation.__main__:simulate"),
        ("roundel simulate configs/demo/scene.yaml recording --seconds 15",),
    ),
    "doctor": Command(
        "check this machine, the files of an arena and a running server",
        _class_or_function("fusion.commands.doctor:doctor"),
        ("roundel doctor", "roundel doctor --config arena.yaml"),
    ),
}


def main() -> None:
    """The entry point of `roundel`."""
    # A child that is started as `python -m` in a checkout would import the sources there instead of the package.
    os.environ.setdefault("PYTHONSAFEPATH", "1")
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(overview())
    elif arguments[0] == "--version":
        print(f"roundel {version('roundel')}")
    else:
        run(lambda: execute(*arguments))


def execute(name: str, *arguments: str) -> int | None:
    """Run one command; return its exit code."""
    further = {} if name in COMMANDS else _further()
    check_command([name], (*COMMANDS, *further), "roundel --help lists the commands")
    command = COMMANDS.get(name) or further.get(name)
    if command is None:
        raise ConfigError(f"{name} needs a command before it; roundel --help lists them")
    set_up_logging(command.log_level)
    try:
        return command.run(f"roundel {name}", arguments, command.examples)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if (extra := _extra_of(package)) is None:
            raise
        raise ConfigError(
            f"roundel {name} needs {package}, which a camera's machine does not; pip install 'roundel[{extra}]'"
        ) from None


def _extra_of(package: str) -> str | None:
    """The extra that installs a package; None if none does."""
    for requirement in requires("roundel") or ():
        name, extra = re.match(r"[\w-]+", requirement), re.search(r"extra == ['\"](\w+)", requirement)
        if name and extra and name[0] == package:
            return extra[1]
    return None


def overview() -> str:
    """The list of commands."""
    rows = [f"  {name:10} {command.summary}" for name, command in COMMANDS.items()]
    return "\n".join(
        [
            "usage: roundel COMMAND [OPTIONS]",
            "",
            "Locates printed roundels with cameras. The commands, in the order of the work:",
            *rows,
            "",
            f"Also: {', '.join(_further())}.",
            "roundel COMMAND --help shows options and examples; roundel --version the version.",
        ]
    )


def _further() -> dict[str, Command]:
    """The commands of `fusion` that are not in `COMMANDS`, under the same names."""
    from fusion.__main__ import COMMANDS as fusion_commands

    return {
        name: Command("", _class_or_function(f"fusion.commands.{module}:{name}"), ())
        for name, module in fusion_commands.items()
        if name not in COMMANDS
    }


if __name__ == "__main__":
    main()
