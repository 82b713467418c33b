# SPDX-License-Identifier: BSD-3-Clause
"""Builds a native core with a C++ driver, without Python and without vector instructions, and fuzzes it."""

import subprocess
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

SHARED = Path(__file__).parents[1] / "camera_node" / "native"  # whose headers fusion includes, too
FLAGS = ["-std=c++20", "-O1", "-DROUNDEL_SCALAR", "-ffp-contract=off", f"-I{SHARED}"]


def build(
    native: Path, driver: Path, folder: Path, only: Sequence[str] = ("*",), flags: Sequence[str] = ()
) -> Path:
    """Compile and link a driver with the sources of `native`, all or those named `only`, except for bindings."""

    def compile_one(source: Path) -> Path:
        made = folder / f"{source.parent.name}_{source.stem}.o"
        command = ["c++", f"-I{native}", *FLAGS, *flags, "-c", source, "-o", made]
        subprocess.run(command, check=True, timeout=300)
        return made

    sources = [path for name in only for path in native.rglob(f"{name}.cpp")]
    sources = [path for path in sources if not path.name.startswith("bind")]
    with ThreadPoolExecutor(2) as pool:
        objects = list(pool.map(compile_one, [*sources, driver]))
    program = folder / driver.stem
    subprocess.run(["c++", *flags, *objects, "-o", program], check=True, timeout=300)
    return program


def fuzz(
    native: Path, driver: Path, rounds: int, folder: Path, checks: Iterable[str] = ("address", "undefined")
) -> tuple[int, str]:
    """Run `rounds` of a fuzzing driver under sanitizers; returns its exit code and stderr."""
    sanitizers = ["-g", f"-fsanitize={','.join(checks)}", "-fno-sanitize-recover=all"]
    program = build(native, driver, folder, flags=sanitizers)
    done = subprocess.run([program, str(rounds)], capture_output=True, text=True, timeout=300)
    return done.returncode, done.stderr
