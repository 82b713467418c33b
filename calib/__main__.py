# SPDX-License-Identifier: BSD-3-Clause
"""`python -m calib`: lenses, where cameras stand, and the world they stand in."""

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import tyro
from rich.console import Console
from rich.progress import track

from calib.board import BoardFinder, make_board
from calib.errors import CalibrationError
from calib.intrinsics import calibrate_lens, find_cameras, merge, read_frames
from calib.live import collect, publish
from calib.report import print_report
from calib.rig import Rig, load_rig, save_rig
from calib.world import align, read_positions
from camera_node.body import Body
from camera_node.config import load_yaml
from camera_node.errors import ConfigError, run
from camera_node.messages import Detections
from camera_node.network import open_client
from camera_node.observations import detect_frames, read_observations


@dataclass(frozen=True, kw_only=True)
class Wand:
    """Place the cameras by a wand that was waved before them."""

    wand: Path = Path("configs/wand.yaml")
    """The wand: diameter_m and markers, metres."""
    rig: Path
    """Intrinsics of every camera; poses in it are not used."""
    out: Path
    """Where the rig with poses is written."""
    frames: Path | None = None
    """Detect in <FOLDER>/<camera>/<t_ns>.png|jpg."""
    observations: Path | None = None
    """Or take marker centres from a CSV: t_ns,camera,u,v[,marker]."""
    live: bool = False
    """Or subscribe to the running cameras, and hand them the result."""
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Zenoh endpoints of the server."""
    arena: str = "arena"
    """The arena's name in the keys."""
    seconds: float = 30.0
    """How long to wave."""
    zenoh: Path | None = None
    """A Zenoh configuration of your own."""


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """Calibrate lenses from frames of a ChArUco board."""

    frames: Path
    """A folder of <camera>/*.png|jpg, a folder of one camera's images, a video, or a folder of videos."""
    board: str
    """charuco:COLSxROWS:SQUARE_M[:MARKER_RATIO[:DICTIONARY]]"""
    out: Path
    """The rig; other cameras in it are kept."""
    camera: str | None = None
    """The camera's name, or the only one to calibrate."""


@dataclass(frozen=True, kw_only=True)
class World:
    """Move the world so that cameras stand where they were surveyed."""

    rig: Path
    """A rig with poses."""
    positions: Path
    """CSV with camera,x,y,z: three or more cameras, metres."""
    out: Path
    """Where the moved rig is written."""


Command = (
    Annotated[Wand, tyro.conf.subcommand("wand")]
    | Annotated[Intrinsics, tyro.conf.subcommand("intrinsics")]
    | Annotated[World, tyro.conf.subcommand("world")]
)


def main() -> None:
    """The program `roundel-calib`."""
    run(lambda: execute(tyro.cli(Command, prog="calib", description=__doc__)))


def execute(command: Wand | Intrinsics | World) -> None:
    """Do what the command line asks."""
    console = Console()
    if not command.out.parent.is_dir():
        raise ConfigError(f"{command.out.parent} is no folder; --out can't be written there")
    if isinstance(command, Wand):
        run_wand(command, console)
    elif isinstance(command, Intrinsics):
        run_intrinsics(command, console)
    else:
        run_world(command, console)


def run_wand(command: Wand, console: Console) -> None:
    """`calib wand`: nothing is written unless two cameras or more were placed."""
    if (command.frames is not None) + (command.observations is not None) + command.live != 1:
        raise ConfigError("give one of --frames FOLDER, --observations CSV and --live")
    if command.live and not command.seconds > 0:
        raise ConfigError(f"--seconds is {command.seconds}; it must be above 0")
    rig, wand = load_rig(command.rig), load_yaml(command.wand, Body)
    if command.live:
        _run_live(command, rig, wand, console)
    else:
        _place(command, rig, wand, _recorded(command, rig, wand), console)


def _recorded(command: Wand, rig: Rig, wand: Body) -> list[Detections]:
    if command.frames is not None:
        _check_folders(command.frames, rig)
        return detect_frames(command.frames, inner_ratios=(wand.inner_ratio,))
    assert command.observations is not None
    sizes = {name: (lens.width, lens.height) for name, lens in rig.cameras.items()}
    return read_observations(command.observations, sizes)


def _check_folders(folder: Path, rig: Rig) -> None:
    """Say before the minutes of detection what would be said after them."""
    names = sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    if unknown := [name for name in names if name not in rig.cameras]:
        raise CalibrationError(
            f"{folder / unknown[0]} is no camera of the rig, which has {', '.join(sorted(rig.cameras))}; rename "
            f"the folder, or run python -m calib intrinsics --camera {unknown[0]}"
        )
    if len(names) == 1:
        raise CalibrationError(
            f"{folder} holds one camera, '{names[0]}'; a wand calibration needs two or more"
        )


def _place(command: Wand, rig: Rig, wand: Body, messages: Sequence[Detections], console: Console) -> Rig:
    from calib.wand import calibrate

    with console.status("placing cameras"):
        result = calibrate(rig, wand, messages)
    print_report(result.report, console)
    text = shlex.join(["python", "-m", "calib", *sys.argv[1:]])
    placed = msgspec.structs.replace(result.rig, calibration=result.report.as_dict(text))
    save_rig(placed, command.out)
    console.print(f"wrote {command.out}", highlight=False, soft_wrap=True)
    return placed


def _run_live(command: Wand, rig: Rig, wand: Body, console: Console) -> None:
    with open_client(command.connect, command.zenoh) as session:
        messages, bad = collect(session, command.arena, command.seconds)
        if bad:
            console.print(f"warning: {bad} messages were none and were skipped")
        placed = _place(command, rig, wand, messages, console)
        if not publish(session, command.arena, placed):
            console.print("warning: nobody took the rig; give the server the file that was written")


def run_intrinsics(command: Intrinsics, console: Console) -> None:
    """`calib intrinsics`: writes the cameras' entries, keeps the others."""
    finder = BoardFinder(make_board(command.board))
    rig = load_rig(command.out) if command.out.exists() else None
    lenses = {}
    for name, path in find_cameras(command.frames, command.camera).items():
        frames = track(read_frames(path), f"finding the board for {name}", transient=True, console=console)
        lens = lenses[name] = calibrate_lens(name, frames, finder)
        console.print(
            f"{name}: {lens.views} views of {lens.frames} frames, residual {lens.rms_px:.3f} px, "
            f"focal length {lens.camera.fx:.1f} px, corners in {lens.coverage:.0%} of the image",
            highlight=False,
            soft_wrap=True,
        )
        if lens.coverage < 0.6:
            console.print(
                f"warning: {name}: show the board near the image's edges too; distortion is guessed there"
            )
    save_rig(merge(rig, lenses), command.out)
    console.print(f"wrote {command.out}", highlight=False, soft_wrap=True)


def run_world(command: World, console: Console) -> None:
    """`calib world`: aligns to surveyed camera positions."""
    rig = load_rig(command.rig)
    rig.require_placed(command.rig)
    moved, misses = align(rig, read_positions(command.positions))
    for name, miss in misses.items():
        console.print(f"{name}: {miss * 1e3:.1f} mm from its surveyed place", highlight=False, soft_wrap=True)
    save_rig(moved, command.out)
    console.print(f"wrote {command.out}", highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
