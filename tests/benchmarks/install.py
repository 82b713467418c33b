# SPDX-License-Identifier: BSD-3-Clause
"""The time of an installation of the server from a wheel: `python -m tests.benchmarks.install [--times 3]`.

As a new user without a compiler has it: an empty home and cache, a new environment, and wheels only. Each number is the
least of several runs. The index of packages is that of the machine's configuration, so that times depend on the
network; the line on the download says how much. `uv` is the one on the path, or that of `make constraints`.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import tyro
from rich.table import Table

from camera_node.foundation.terminal import console, say
from tests.conftest import ROOT

CACHES = (
    "PIP_CACHE_DIR",
    "PIP_NO_CACHE_DIR",
    "UV_CACHE_DIR",
    "XDG_CACHE_HOME",
    "XDG_DATA_HOME",
    "XDG_BIN_HOME",
)
WHEELS_ONLY = {"PIP_ONLY_BINARY": ":all:", "UV_NO_BUILD": "1"}
VENV = (sys.executable, "-m", "venv", "roundel")
PIP = "roundel/bin/pip"
IN_VENV, AS_TOOL = "roundel/bin/roundel", ".local/bin/roundel"
START = ("print", "wand")
N_LARGEST = 6


def main(times: int = 3, wheel: Path | None = None) -> None:
    """Print the seconds of each step, and the largest packages.

    Args:
        times: how often each installation is made.
        wheel: of this package; built if not given.
    """
    with tempfile.TemporaryDirectory(prefix="roundel-install-") as folder:
        wheel = (wheel or build_wheel(Path(folder))).resolve()
        table = Table("installation", "environment, s", "installation, s", "first start, s", "next start, s")
        for name, steps in ways(f"{wheel}[server]").items():
            runs = [time_steps(steps) for _ in range(times)]
            table.add_row(name, *(f"{min(seconds):.1f}" for seconds in zip(*runs, strict=True)))
        console().print(table)
        say(measure_download(f"{wheel}[server]", Path(folder), times))
    say(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def build_wheel(folder: Path) -> Path:
    """Build the package's wheel with the modules that `make setup` compiled."""
    build = [*(sys.executable, "-m", "pip", "wheel"), "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*build, "--wheel-dir", str(folder), str(ROOT)], check=True)
    return next(folder.glob("roundel-*.whl"))


def ways(requirement: str) -> dict[str, Sequence[Sequence[str]]]:
    """The commands of each kind of installation: environment, installation, and two starts of a program."""
    pip: dict[str, Sequence[Sequence[str]]] = {
        f"pip install {option}".rstrip(): [
            VENV,
            [PIP, "install", *option.split(), requirement],
            [IN_VENV, *START],
            [IN_VENV, *START, "again.pdf"],
        ]
        for option in ("", "--no-compile")
    }
    uv = shutil.which("uv") or shutil.which("uv", path=str(ROOT / "build" / "resolver" / "bin"))
    if uv is None:
        say("uv is not measured: it is not on the path, and `make constraints` did not install it")
        return pip
    # uv makes the environment within the installation.
    tool: Sequence[Sequence[str]] = [
        ["true"],
        [uv, "tool", "install", requirement],
        [AS_TOOL, *START],
        [AS_TOOL, *START, "again.pdf"],
    ]
    return {**pip, "uv tool install": tool}


def time_steps(steps: Sequence[Sequence[str]]) -> list[float]:
    """The seconds of each command, in a new home."""
    with tempfile.TemporaryDirectory(prefix="roundel-home-") as home:
        return [time_command(step, home) for step in steps]


def time_command(command: Sequence[str], home: str) -> float:
    """The seconds of one command in a home, whose caches are its own."""
    begun_s = time.monotonic()
    done = subprocess.run(command, cwd=home, env=environment(home), capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(command)} failed: {done.stderr.strip()}")
    return time.monotonic() - begun_s


def environment(home: str) -> Mapping[str, str]:
    """This one, but with the caches of a new user, and without source distributions."""
    return (
        {key: value for key, value in os.environ.items() if key not in CACHES} | {"HOME": home} | WHEELS_ONLY
    )


def measure_download(requirement: str, folder: Path, times: int) -> str:
    """State how long the download of all packages takes, and how large the largest ones are."""
    seconds, place = [], folder / "packages"
    for _ in range(times):
        shutil.rmtree(place, ignore_errors=True)
        with tempfile.TemporaryDirectory(prefix="roundel-home-") as home:
            words = [sys.executable, "-m", "pip", "download", "--dest", str(place), requirement]
            seconds.append(time_command(words, home))
    sizes = {path.name.split("-")[0]: path.stat().st_size / 1e6 for path in place.iterdir()}
    largest = sorted(sizes, key=lambda name: -sizes[name])[:N_LARGEST]
    return (
        f"pip download alone: {min(seconds):.1f} s, {sum(sizes.values()):.0f} MB in {len(sizes)} packages; "
        f"the largest: {', '.join(f'{name} {sizes[name]:.0f}' for name in largest)}"
    )


if __name__ == "__main__":
    tyro.cli(main)
