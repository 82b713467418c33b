# SPDX-License-Identifier: BSD-3-Clause
"""Memory and time of the commands on recordings of any length: `python -m tests.benchmarks.recordings [--gb 0.5 2]`;
with --damaged 200, what they say of a recording with one wrong byte.

The recording has 8 cameras, 50 robots, and their poses, for as long as it takes to reach each size; a few seconds of
messages are repeated with later times. A command's peak memory must not depend on the size. Times are given as a
multiple of the recorded time.
"""

import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import msgspec
import tyro
from rich.table import Table

from calib.rig.recording import RecordingWriter, read_messages
from calib.rig.rig import Rig
from calib.rig.rig_messages import RigMessage
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import console, say
from camera_node.protocol.messages import Detections, Keys, encode
from fusion.protocol.pose_messages import RobotPose, Robots, robots_key
from fusion.recordings.offline_fusion import OfflineArena, fuse_recording
from fusion.recordings.recording_files import trim_recording
from tests.benchmarks.fusion_load import Load
from tests.conftest import ROOT
from tests.processes import run_program

ARENA = "large"
KEYS = Keys(ARENA)
LIMIT_MB = 300
BLOCK_S = 6.0  # of messages that are repeated; all motions have this period
# Prints the exit code and the peak memory of a command. Linux counts what the parent had at the fork, so that is
# a small process.
PEAK = """
import resource, subprocess, sys
code = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL)
print(code, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""
COMMANDS = {
    "repair": ("repair", "{path}"),
    "repair, cut off": ("repair", "{cut}"),
    "trim": ("trim", "{path}", "{folder}/part.mcap", "--from-s", "1"),
    "replay": ("replay", "{path}", "--out", "{folder}/poses.csv"),
    "replay --smooth": ("replay", "{path}", "--smooth", "--out", "{folder}/smooth.mcap"),
    **{
        f"export to {name}": ("export", "{path}", "{folder}/" + name)
        for name in ("x.csv", "x.tum", "x.parquet")
    },
    "export to observations": ("export", "{path}", "{folder}/x.csv", "--format", "observations"),
    "export to Foxglove": ("export", "{path}", "{folder}/foxglove.mcap"),
    "export to Rerun": ("export", "{path}", "{folder}/x.rrd"),
    "export to a ROS 2 bag": ("export", "{path}", "{folder}/bag"),
    "plot": ("plot", "{path}", "--out", "{folder}/x.png"),
    "view": ("view", "--replay", "{path}", "--headless", "--seconds", "10"),
}
SAMPLE = ROOT / "configs" / "sample" / "recording.mcap"


def main(
    gb: tuple[float, ...] = (0.25, 1.0), robots: int = 50, only: tuple[str, ...] = ("",), damaged: int = 0
) -> None:
    """Print the peak memory of each command for each size of the recording.

    Args:
        gb: sizes of the recording, in GB.
        robots: with 4 markers each, seen by 8 free-running cameras at 60 Hz.
        only: commands whose names contain one of these texts.
        damaged: in place of it, give each command copies of a short recording with one wrong byte, at so many places.
    """
    if damaged:
        sys.exit(
            not try_damaged(damaged, {n: c for n, c in COMMANDS.items() if any(text in n for text in only)})
        )
    load = Load(robots=robots, period_s=BLOCK_S)
    columns = [heading for size in gb for heading in (f"{size:g} GB: MB", "of its time")]
    table = Table("command", *columns)
    chosen = {name: command for name, command in COMMANDS.items() if any(text in name for text in only)}
    rows: dict[str, list[str]] = {name: [name] for name in chosen}
    has_failed = False
    for size in gb:
        with tempfile.TemporaryDirectory(dir="build" if Path("build").is_dir() else None) as name:
            folder = Path(name)
            path = folder / "large.mcap"
            seconds = write(path, load, size)
            say(f"{path.stat().st_size / 1e9:.2f} GB, {seconds:.0f} s")
            for command, arguments in chosen.items():
                peak_mb, elapsed_s, code = run(arguments, path, folder)
                has_failed |= code != 0 or peak_mb > LIMIT_MB
                say(f"{command}: {peak_mb:.0f} MB, {elapsed_s:.0f} s, exit code {code}")
                rows[command] += [
                    f"{peak_mb:.0f}",
                    f"{elapsed_s / seconds:.2f}" if not code else f"exit {code}",
                ]
    for row in rows.values():
        table.add_row(*row)
    console().print(table)
    sys.exit(has_failed)


def write(path: Path, load: Load, gb: float) -> float:
    """Write a recording of at least this size; its length in seconds."""
    block = list(load.messages(BLOCK_S))
    arena = OfflineArena(load.rig, load.bodies)
    poses = [p for fused in fuse_recording(((m.t_ns, m) for m in block), arena) for p in fused.poses]
    with RecordingWriter(path) as writer:
        start_ns, repetition = block[0].t_ns, 0
        writer.put(KEYS.rig, encode(RigMessage(t_ns=start_ns, rig=Rig(cameras=load.rig))), start_ns)
        writer.put(robots_key(ARENA), encode(Robots(robots=load.bodies)), start_ns)
        while writer.size < gb * 1e9:
            for key, message in repeated(block, poses, repetition):
                writer.put(key, encode(message), message.t_ns)
            repetition += 1
    return repetition * BLOCK_S


def repeated(
    block: list[Detections], poses: list[RobotPose], n: int
) -> Iterator[tuple[str, Detections | RobotPose]]:
    """The messages, n times the block later, in order of time, with their keys."""
    later_ns = round(n * BLOCK_S * 1e9)
    for message in sorted((*block, *poses), key=lambda m: m.t_ns):
        shifted = msgspec.structs.replace(message, t_ns=message.t_ns + later_ns)
        if isinstance(shifted, Detections):
            yield KEYS.detections(shifted.camera), shifted
        else:
            yield KEYS.robot_pose(shifted.robot), shifted


def try_damaged(n: int, commands: dict[str, tuple[str, ...]]) -> bool:
    """Whether each command says what is missing of each copy, and ends as it should."""
    noise, failed, n_lost = random.Random(1), 0, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        trim_recording(SAMPLE, folder / "whole.mcap", 2.0, 4.0)
        whole = (folder / "whole.mcap").read_bytes()
        n_whole = sum(1 for _ in read_messages(folder / "whole.mcap"))
        for at in (noise.randrange(len(whole)) for _ in range(n)):
            data = bytearray(whole)
            data[at] ^= 1 << noise.randrange(8)
            path, faults = folder / "large.mcap", Counter[str]()
            path.write_bytes(data)
            try:
                is_lost = sum(1 for _ in read_messages(path, faults)) < n_whole
            except ConfigError:
                is_lost = True  # the first bytes are not those of the format
            n_lost += is_lost
            for command, arguments in commands.items():
                path.write_bytes(data)
                done = run_program(
                    "fusion", *(a.format(path=path, cut=path, folder=folder) for a in arguments)
                )
                said = done.stdout + done.stderr
                is_named = not is_lost or "skipped" in said or "not an MCAP" in said
                if done.returncode not in (0, 2) or "Traceback" in said or not is_named:
                    failed += 1
                    say(f"byte {at}, {command}: exit code {done.returncode}: {said[-500:]} {dict(faults)}")
                for left in folder.iterdir():
                    if left.name not in ("large.mcap", "whole.mcap"):
                        subprocess.run(["rm", "-r", left], check=True)
    say(f"{n} bytes, {n_lost} of which cost messages; {len(commands)} commands: {failed} failures")
    return not failed


def run(arguments: tuple[str, ...], path: Path, folder: Path) -> tuple[float, float, int]:
    """Peak memory (MB), time (s) and exit code of a command."""
    cut = folder / "cut.mcap"
    if any("{cut}" in argument for argument in arguments):
        subprocess.run(["cp", path, cut], check=True)
        with cut.open("rb+") as file:
            file.truncate(path.stat().st_size * 9 // 10)
    filled = [argument.format(path=path, cut=cut, folder=folder) for argument in arguments]
    start_s = time.monotonic()
    command = [sys.executable, "-c", PEAK, Path(sys.executable).with_name("roundel"), *filled]
    code, peak_kb = map(
        int, subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.split()
    )
    elapsed_s = time.monotonic() - start_s
    for left in folder.iterdir():
        if left != path:
            subprocess.run(["rm", "-r", left], check=True)
    return peak_kb / 1e3, elapsed_s, code


if __name__ == "__main__":
    tyro.cli(main)
