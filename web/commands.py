# SPDX-License-Identifier: BSD-3-Clause
"""Runs commands of the other programs in processes of their own, because they take the processor for seconds."""

import subprocess
import sys

from web.errors import WebError

NAMES = {"calib": "calibrate "}  # between `roundel` and the name of a command
TIMEOUT_S = 1800.0  # a recording of hours is fused in this time


def run_program(program: str, *words: object, timeout_s: float = TIMEOUT_S) -> None:
    """Run `python -m PROGRAM WORDS`.

    Raises:
        WebError: it failed, with its error message, or it did not end within `timeout_s`.
    """
    name = f"roundel {NAMES.get(program, '')}{words[0]}"
    command = [sys.executable, "-m", program, *map(str, words)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired:
        raise WebError(f"{name} did not end within {timeout_s:.0f} s") from None
    if done.returncode:
        raise WebError(done.stderr.strip().removeprefix("error: ") or f"{name} ended with {done.returncode}")
