# SPDX-License-Identifier: BSD-3-Clause
"""A native core with a driver that tries to break it, under AddressSanitizer and UBSan."""

import subprocess
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

FLAGS = ["-std=c++20", "-O1", "-g", "-DROUNDEL_SCALAR", "-ffp-contract=off"]


def fuzz(
    native: Path, driver: Path, rounds: int, folder: Path, checks: Iterable[str] = ("address", "undefined")
) -> tuple[int, str]:
    """Build the sources of `native`, bindings left out, with a driver, and run so many rounds; exit code and stderr."""
    sanitizers = [f"-fsanitize={','.join(checks)}", "-fno-sanitize-recover=all"]

    def build(source: Path) -> Path:
        made = folder / f"{source.stem}.o"
        command = ["c++", *FLAGS, f"-I{native}", *sanitizers, "-c", source, "-o", made]
        subprocess.run(command, check=True, timeout=300)
        return made

    sources = [path for path in native.glob("*.cpp") if not path.name.startswith("bind")]
    with ThreadPoolExecutor(2) as pool:
        objects = list(pool.map(build, [*sources, driver]))
    subprocess.run(["c++", *sanitizers, *objects, "-o", folder / "fuzz"], check=True, timeout=300)
    done = subprocess.run([folder / "fuzz", str(rounds)], capture_output=True, text=True, timeout=300)
    return done.returncode, done.stderr
